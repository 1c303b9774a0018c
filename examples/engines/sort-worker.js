// Sorts splats from far to near: a counting sort by 16 bits of depth. No dependencies.
let positions = new Float32Array(0), build = 0; // three numbers a splat

onmessage = ({ data }) => {
  if (data.positions) [positions, build] = [data.positions, data.build];
  if (!data.forward) return;
  const count = positions.length / 3, [x, y, z] = data.forward, depths = new Float32Array(count);
  let least = Infinity, most = -Infinity;
  for (let k = 0; k < count; k++) {
    const depth = x * positions[3 * k] + y * positions[3 * k + 1] + z * positions[3 * k + 2];
    depths[k] = depth;
    least = Math.min(least, depth);
    most = Math.max(most, depth);
  }
  const keys = new Uint16Array(count), starts = new Uint32Array(65537), steps = 65535 / (most - least || 1);
  for (let k = 0; k < count; k++) {
    keys[k] = steps * (most - depths[k]);
    starts[keys[k] + 1]++;
  }
  for (let k = 0; k < 65536; k++) starts[k + 1] += starts[k];
  const order = new Uint32Array(count);
  for (let k = 0; k < count; k++) order[starts[keys[k]]++] = k;
  postMessage({ order, build }, [order.buffer]);
};
