"""Commands of the secure mode: certificates and the router."""
