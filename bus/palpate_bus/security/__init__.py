"""Certificates, and the access rules of a router, derived from the contract."""

DAYS = 825
"""Days that a certificate holds unless said otherwise."""
