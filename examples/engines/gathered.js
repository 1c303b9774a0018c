// For engines that sort one thing at a time: what is shown goes into one thing, which is built again when it changes. No dependencies.

/** Returns a player for `runScene`. `read(url)` resolves to what a leaf holds; `build(held)` puts all that is shown together, and may take a while. */
export function gatherShown(read, build) {
  const shown = new Set();
  let stale = false, busy = false;
  const rebuild = async () => {
    if (busy || !stale) return;
    [busy, stale] = [true, false];
    try {
      await build([...shown]);
    } finally {
      busy = false;
    }
    requestAnimationFrame(rebuild);
  };
  const change = (thing, yes) => {
    if (shown.has(thing) === yes) return;
    if (yes) shown.add(thing);
    else shown.delete(thing);
    stale = true;
    requestAnimationFrame(rebuild); // once for all changes of a frame
  };
  return { load: read, show: change, free: (thing) => change(thing, false) };
}

/** Returns arrays of one type, one after the other. */
export function joined(arrays, type = Uint8Array) {
  const all = new type(arrays.reduce((sum, { length }) => sum + length, 0));
  arrays.reduce((at, array) => (all.set(array, at), at + array.length), 0);
  return all;
}
