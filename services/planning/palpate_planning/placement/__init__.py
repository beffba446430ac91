"""Placement: postures of the redundant arm that carry out a whole scan with the most margin."""
