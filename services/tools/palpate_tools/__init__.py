"""Tools to look at a live bus, and the conformance kit for implementations of a role."""
