// Pinhole cameras of the scene's frame: axes as in OpenCV (+x right, +y down, +z forward), centers of pixels at +0.5.
import type { Camera, Pose, View } from "./types.ts";

/** Return the rotation of a quaternion wxyz of any length > 0, world from camera, row by row. */
export function rotationOf(quaternion: readonly number[]): number[] {
  const [w, x, y, z] = quaternion;
  const s = 2 / (w * w + x * x + y * y + z * z);
  return [
    1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
    s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x),
    s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y),
  ];
}

/** Return the unit quaternion wxyz of a rotation, row by row: from the largest of its four components. */
export function quaternionOf(rotation: readonly number[]): [number, number, number, number] {
  const r = rotation, w = 1 + r[0] + r[4] + r[8], x = 1 + r[0] - r[4] - r[8], y = 1 - r[0] + r[4] - r[8],
    z = 1 - r[0] - r[4] + r[8];
  const most = Math.max(w, x, y, z), n = 0.5 / Math.sqrt(most);
  if (most === w) return [w * n, (r[7] - r[5]) * n, (r[2] - r[6]) * n, (r[3] - r[1]) * n];
  if (most === x) return [(r[7] - r[5]) * n, x * n, (r[1] + r[3]) * n, (r[2] + r[6]) * n];
  if (most === y) return [(r[2] - r[6]) * n, (r[1] + r[3]) * n, y * n, (r[5] + r[7]) * n];
  return [(r[3] - r[1]) * n, (r[2] + r[6]) * n, (r[5] + r[7]) * n, z * n];
}

/** Return the rotation camera from world, row by row: rows are the camera's axes in the world. */
export function axesOf(pose: Pose): number[] {
  const r = rotationOf(pose.rotation);
  return [r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]];
}

/** Return the camera of a picture of `width` x `height` pixels whose height covers the angle `fovY`, in radians. */
export function cameraOf(pose: Pose, width: number, height: number, fovY: number): Camera {
  const focal = height / 2 / Math.tan(fovY / 2), { position, rotation } = pose;
  return { position, rotation, width, height, fx: focal, fy: focal, cx: width / 2, cy: height / 2 };
}

/** Return what a camera sees: tangents of the angles from its axis to the four borders. */
export function viewOf(camera: Camera): View {
  const { width, height, fx, fy, cx, cy } = camera;
  return { left: cx / fx, right: (width - cx) / fx, up: cy / fy, down: (height - cy) / fy };
}

/** Return whether two cameras show the same picture. */
export function sameCamera(a: Camera, b: Camera): boolean {
  const numbers = (c: Camera) => [...c.position, ...c.rotation, c.width, c.height, c.fx, c.fy, c.cx, c.cy];
  const left = numbers(a), right = numbers(b);
  return left.every((value, k) => value === right[k]);
}

/** Return the angle in radians by which the axes of two poses differ. */
export function angleBetween(a: Pose, b: Pose): number {
  let dot = 0, aa = 0, bb = 0;
  for (let k = 0; k < 4; k++) {
    dot += a.rotation[k] * b.rotation[k];
    aa += a.rotation[k] ** 2;
    bb += b.rotation[k] ** 2;
  }
  return 2 * Math.acos(Math.min(1, Math.abs(dot) / Math.sqrt(aa * bb)));
}
