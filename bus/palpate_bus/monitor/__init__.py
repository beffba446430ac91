"""Checks of a live bus against the contract."""
