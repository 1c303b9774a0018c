// A camera to walk with, for both pages: drag to look, W A S D and Q E to move. No dependencies. Frame of the scene.

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const plus = (a, b, factor = 1) => a.map((value, k) => value + factor * b[k]);
const unit = (a) => a.map((value) => value / (Math.hypot(...a) || 1));

/** Turns a vector about a unit axis. */
function turn(v, axis, angle) {
  const along = axis.reduce((sum, a, k) => sum + a * v[k], 0), side = cross(axis, v);
  return v.map((value, k) => value * Math.cos(angle) + side[k] * Math.sin(angle) + axis[k] * along * (1 - Math.cos(angle)));
}

export class Walk {
  /** Begins at `eye` and `target` of the page's address ("x,y,z"), or at the first pose of the sidecar. */
  constructor(canvas, header, asked = new URLSearchParams(location.search)) {
    const triple = (name) => asked.get(name)?.split(",").map(Number);
    const { position, rotation: [w, x, y, z] } = header.poses[0];
    this.up = header.up;
    this.position = triple("eye") ?? [...position];
    const ahead = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]; // +z of the camera
    this.forward = unit(asked.has("target") ? plus(triple("target"), this.position, -1) : ahead);
    this.speed = Number(asked.get("speed") ?? (header.size || 1));
    this.pressed = new Set();
    canvas.addEventListener("pointermove", (event) => {
      if (event.buttons) this.look(-0.004 * event.movementX, -0.004 * event.movementY);
    });
    addEventListener("keydown", (event) => this.pressed.add(event.code));
    addEventListener("keyup", (event) => this.pressed.delete(event.code));
    addEventListener("blur", () => this.pressed.clear());
  }

  look(aside, upward) {
    const right = unit(cross(this.forward, this.up));
    const tilted = turn(this.forward, right, upward);
    if (Math.abs(tilted.reduce((sum, v, k) => sum + v * this.up[k], 0)) < 0.98) this.forward = unit(tilted);
    this.forward = unit(turn(this.forward, this.up, aside));
  }

  /** Moves on by so many seconds; returns the point that the camera looks at. */
  step(seconds) {
    const right = unit(cross(this.forward, this.up));
    const ways = { KeyW: [this.forward, 1], KeyS: [this.forward, -1], KeyD: [right, 1], KeyA: [right, -1], KeyE: [this.up, 1], KeyQ: [this.up, -1] };
    for (const key of this.pressed) {
      if (ways[key]) this.position = plus(this.position, ways[key][0], ways[key][1] * this.speed * seconds);
    }
    return plus(this.position, this.forward);
  }
}
