"""Kernels of the room `render`, one concept a file; they take checked, contiguous arrays."""
