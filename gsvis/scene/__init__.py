"""What the world is: Gaussians, cameras, navigable space and scenes with known visibility."""
