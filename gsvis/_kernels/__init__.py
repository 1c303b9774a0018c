"""Kernels that several rooms call: bits of packed words, vector instructions, faces of the direction set."""
