"""Visibility of a whole scene: which Gaussians its views need, and from how many directions each can be seen."""

from gsvis.visibility.analysis import (
    FACE_LIMITS,
    PAPER,
    Agreement,
    Analysis,
    AnalysisConfig,
    DirectionCdf,
    Settling,
    analyze,
)

__all__ = ["FACE_LIMITS", "PAPER", "Agreement", "Analysis", "AnalysisConfig", "DirectionCdf", "Settling", "analyze"]
