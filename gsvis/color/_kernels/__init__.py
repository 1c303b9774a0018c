"""Kernels of the room `color`, one concept per file. They take checked, contiguous arrays."""
