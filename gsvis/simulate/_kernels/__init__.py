"""Kernels of the room `simulate`, one concept per file. They take checked, contiguous arrays."""
