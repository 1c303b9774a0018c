"""Kernels of the room `package`, one concept a file; they take checked, contiguous arrays."""
