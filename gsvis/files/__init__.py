"""Bytes on disk that are no scene: atomic writes, locks, the Arrow container, limits, caches, kept results."""
