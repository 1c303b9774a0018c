"""Kernels of the room `raycast`, one concept per file. They take checked, contiguous arrays."""
