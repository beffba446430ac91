"""Runtimes that step services in lockstep or by the wall clock, over zenoh or in one process."""
