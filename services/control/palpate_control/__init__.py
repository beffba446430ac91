"""Cartesian and joint impedance control at 1 kHz: `impedance` is the law, `reference` its set-points."""
