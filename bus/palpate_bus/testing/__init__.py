"""Tools for tests of services: messages of any type, an inbox filled by hand."""
