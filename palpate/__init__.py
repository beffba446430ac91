"""Palpate: the command line and the Python interface."""
