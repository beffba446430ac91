"""Micro-benchmarks for airspeed velocity."""
