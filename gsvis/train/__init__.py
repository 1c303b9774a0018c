"""Training: from photographs or a finished scene to Gaussians, and to quality levels that share them."""
