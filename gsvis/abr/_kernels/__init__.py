"""Kernels of the room `abr`, one concept a file; they take checked, contiguous arrays."""
