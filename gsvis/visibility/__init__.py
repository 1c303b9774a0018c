"""Visibility of a whole scene: which Gaussians its views need, and from how many directions each can be seen."""

from gsvis.visibility.analysis import PAPER, Agreement, Analysis, AnalysisConfig, DirectionCdf, Settling, analyze

__all__ = ["PAPER", "Agreement", "Analysis", "AnalysisConfig", "DirectionCdf", "Settling", "analyze"]
