"""The conformance kit for implementations of a role."""
