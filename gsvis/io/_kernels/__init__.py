"""Kernels of the room `io`, one concept a file; they take checked, contiguous arrays."""
