"""Kernels of the room `train`, one concept a file; they take checked, contiguous arrays."""
