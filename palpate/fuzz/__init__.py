"""Fuzzing of all that takes bytes or words from others."""
