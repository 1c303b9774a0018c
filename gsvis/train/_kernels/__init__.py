"""Kernels of the room `train`, one concept per file. They take checked, contiguous arrays."""
