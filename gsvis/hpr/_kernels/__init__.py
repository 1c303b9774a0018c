"""Kernels of the room `hpr`, one concept per file. They take checked, contiguous arrays."""
