"""Certificates, and the access rules of a router, derived from the contract."""
