"""Frames, vectors, compiled functions and caches."""
