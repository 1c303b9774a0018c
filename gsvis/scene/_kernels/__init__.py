"""Kernels of the room `scene`, one concept per file. They take checked, contiguous arrays."""
