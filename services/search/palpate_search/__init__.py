"""The search: where to press next, given what was felt so far, and when to stop."""
