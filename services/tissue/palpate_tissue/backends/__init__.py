"""Implementations of the role tissue."""
