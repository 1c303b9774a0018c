"""Colour that can be sent in pieces: spaces, spherical harmonics, and functions on the sphere in their place."""
