"""Generators of the reference pages: each module has `page()`, which returns the Markdown of one page."""
