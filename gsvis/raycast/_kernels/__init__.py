"""Kernels of the room `raycast`, one concept a file; they take checked, contiguous arrays."""
