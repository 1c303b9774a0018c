"""Kernels of the room `pvs`, one concept a file; they take checked, contiguous arrays."""
