"""Kernels of the room `hpr`, one concept a file; they take checked, contiguous arrays."""
