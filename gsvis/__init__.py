"""gsvis: geometry-first visibility and streaming for trained 3D Gaussian Splatting scenes."""
