"""Comparison of palpations of one body, and of outcomes of several bodies."""
