"""Implementations of the role camera."""
