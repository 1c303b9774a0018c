"""Kernels of the room `simulate`, one concept a file; they take checked, contiguous arrays."""
