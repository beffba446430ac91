"""Base classes of every exception that Palpate raises on purpose. Imports nothing, so every package may use it."""


class PalpateError(Exception):
    """Base class. The message names what failed, the value, what is allowed and what to do."""


class UserError(PalpateError, ValueError):
    """Unusable input from a person or a file. The command prints the message as one line and exits with status 2."""


class RunError(PalpateError, RuntimeError):
    """A run or a part of it failed after it started. The command reports what was measured and exits with status 3."""
