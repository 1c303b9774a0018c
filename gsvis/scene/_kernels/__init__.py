"""Kernels of the room `scene`, one concept a file; they take checked, contiguous arrays."""
