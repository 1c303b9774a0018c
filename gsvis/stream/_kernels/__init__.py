"""Kernels of the room `stream`, one concept a file; they take checked, contiguous arrays."""
