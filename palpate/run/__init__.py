"""Starts a run, with its processes or in one process, and writes its results."""
