"""Kernels of the room `io`, one concept per file. They take checked, contiguous arrays."""
