"""Fuzzes everything that reads bytes or text from other processes and users."""
