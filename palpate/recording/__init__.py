"""Recordings of other robots: contacts, their faults, and the assessment of them."""
