"""Scan patterns: which points of the skin are felt, and along which lines. Ours are in `lattice`; `choice` finds anybody's."""
