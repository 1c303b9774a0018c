"""Kernels of the room `color`, one concept a file; they take checked, contiguous arrays."""
