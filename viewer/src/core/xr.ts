// Immersive sessions: the eyes of a headset as cameras of the scene. WebXR's frame is meters, +y up, -z forward.
import { quaternionOf, rotationOf } from "./camera.ts";
import type { Camera, Pose } from "./types.ts";

/** What is used of WebXR; browsers' own objects fit. */
export interface XrSession {
  requestReferenceSpace(type: string): Promise<object>;
  requestAnimationFrame(callback: (time: number, frame: XrFrame) => void): number;
  updateRenderState(state: { baseLayer: XrLayer }): Promise<void> | void;
  addEventListener(type: "end", listener: () => void): void;
}

interface XrFrame {
  getViewerPose(space: object): { views: readonly XrView[] } | null | undefined;
}

interface XrView {
  projectionMatrix: Float32Array;
  transform: {
    position: { x: number; y: number; z: number }; orientation: { x: number; y: number; z: number; w: number }
  };
}

interface XrLayer {
  framebuffer: WebGLFramebuffer | null;
  getViewport(view: XrView): { x: number; y: number; width: number; height: number } | null | undefined;
}

/** One eye: its camera, and where its picture goes. */
export interface EyeView {
  lens: Camera;
  framebuffer: WebGLFramebuffer | null;
  x: number;
  y: number;
}

/** The frame of a session in the scene: rotation row by row, origin, scene units in a meter. */
interface XrFrameOfScene {
  rotation: number[];
  origin: [number, number, number];
  scale: number;
}

/** Return the frame whose origin is an eye, whose up is the scene's, and whose forward is the eye's, made level. */
export function frameAt(eye: Pose, up: readonly number[], metersPerUnit: number): XrFrameOfScene {
  const r = rotationOf(eye.rotation), along = r[2] * up[0] + r[5] * up[1] + r[8] * up[2];
  // looking straight up or down
  const steep = Math.abs(along) > 0.99, from = steep ? [-r[1], -r[4], -r[7]] : [r[2], r[5], r[8]];
  const rise = from[0] * up[0] + from[1] * up[1] + from[2] * up[2];
  const level = from.map((value, k) => value - rise * up[k]), length = Math.hypot(...level) || 1;
  const back = level.map((value) => -value / length);
  const right = [
    up[1] * back[2] - up[2] * back[1], up[2] * back[0] - up[0] * back[2], up[0] * back[1] - up[1] * back[0],
  ];
  return {
    rotation: [0, 1, 2].flatMap((k) => [right[k], up[k], back[k]]),
    origin: [...eye.position], scale: 1 / (metersPerUnit || 1),
  };
}

/** Return the camera of an eye of a headset. */
export function lensOf(view: XrView, width: number, height: number, frame: XrFrameOfScene): Camera {
  const p = view.projectionMatrix, { position, orientation } = view.transform, b = frame.rotation;
  const turn = [orientation.w, orientation.x, orientation.y, orientation.z];
  const place = [position.x, position.y, position.z];
  // Turned half around x, axes of WebXR become those of OpenCV.
  const rotation = product(product(quaternionOf(b), turn), [0, 1, 0, 0]);
  const move = (k: number) => frame.origin[k] + frame.scale * (
    b[3 * k] * place[0] + b[3 * k + 1] * place[1] + b[3 * k + 2] * place[2]
  );
  return {
    position: [move(0), move(1), move(2)], rotation: rotation as [number, number, number, number], width, height,
    fx: (p[0] * width) / 2, fy: (p[5] * height) / 2, cx: ((1 - p[8]) * width) / 2, cy: ((1 + p[9]) * height) / 2,
  };
}

/** Call `draw` with the eyes of every frame until the session ends. */
export async function runSession(
  session: XrSession, gl: WebGL2RenderingContext, frame: XrFrameOfScene, draw: (eyes: EyeView[]) => void,
): Promise<void> {
  let ended = false;
  // it may end before the first frame
  const end = new Promise<void>((resolve) => session.addEventListener("end", () => {
    ended = true;
    resolve();
  }));
  await (gl as WebGL2RenderingContext & { makeXRCompatible(): Promise<void> }).makeXRCompatible();
  type Make = new (session: XrSession, gl: WebGL2RenderingContext, options: object) => XrLayer;
  const Layer = (globalThis as unknown as { XRWebGLLayer: Make }).XRWebGLLayer;
  const layer = new Layer(session, gl, { antialias: false, depth: false, stencil: false });
  await session.updateRenderState({ baseLayer: layer });
  const space = await session.requestReferenceSpace("local");
  const step = (_: number, now: XrFrame) => {
    if (ended) return;
    session.requestAnimationFrame(step);
    const eyes = (now.getViewerPose(space)?.views ?? []).flatMap((view): EyeView[] => {
      const port = layer.getViewport(view);
      return port
        ? [{ lens: lensOf(view, port.width, port.height, frame), framebuffer: layer.framebuffer, x: port.x, y: port.y }]
        : [];
    });
    if (eyes.length) draw(eyes);
  };
  if (!ended) session.requestAnimationFrame(step);
  await end;
}

function product(a: readonly number[], b: readonly number[]): number[] {
  return [
    a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3], a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
    a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1], a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
  ];
}
