"""Twins: patients fitted to what was felt."""
