// What a device can be expected to hold.

const MIB = 2 ** 20;

/** Return how many bytes of the GPU a viewer takes at most on this device. */
export function memoryOfDevice(): number {
  return (isSmall() ? 384 : 4096) * MIB;
}

/** Return whether this looks like a phone: little memory, or a finger as the only pointer. */
export function isSmall(): boolean {
  const memory = (navigator as Navigator & { deviceMemory?: number }).deviceMemory;
  return (memory !== undefined && memory <= 4) || matchMedia("(hover: none) and (pointer: coarse)").matches;
}
