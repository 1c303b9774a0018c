"""Kernels of the room `export`, one concept a file; they take checked, contiguous arrays."""
