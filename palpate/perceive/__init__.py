"""Perception of a depth recording, without a run."""
