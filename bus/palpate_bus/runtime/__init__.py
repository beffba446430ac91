"""Runtimes that step services in lockstep or in wall-clock mode, over zenoh or in one process."""
