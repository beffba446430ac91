"""Scenarios: schema, loading, equipment errors and scan patterns."""
