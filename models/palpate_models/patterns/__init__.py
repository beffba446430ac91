"""Scan patterns: which points of the skin are felt, and along which lines.

Ours are in `lattice`; `palpate_models.pattern_choice` finds anybody's.
"""
