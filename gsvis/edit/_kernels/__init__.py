"""Kernels of the room `edit`, one concept per file. They take checked, contiguous arrays."""
