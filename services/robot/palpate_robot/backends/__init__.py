"""Implementations of the role robot."""
