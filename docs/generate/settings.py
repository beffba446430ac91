"""docs/settings.md, from the settings of a process."""

from generate import table
from palpate_bus.settings import COMPOSE_VARIABLES, Settings, allowed_values, text, variable

_HEAD = """# Settings

Generated from [`Settings`](../bus/palpate_bus/settings.py) by `make docs`: every environment variable that the project reads.
`palpate run` and docker-compose.yml set the variables that a service needs; a user rarely sets any. A wrong value is an error,
which names the variable, the value and the allowed values. An empty variable counts as unset. The scenario, not the environment,
says what is examined and how.

"""


def page() -> str:
    """Return the page."""
    rows = [
        (f"`{variable(name)}`", allowed_values(name), _code(text(field.get_default())), field.description or "")
        for name, field in Settings.model_fields.items()
    ]
    rows += [(f"`{name}`", "docker compose only", _code(default), doc) for name, (default, doc) in COMPOSE_VARIABLES.items()]
    return _HEAD + table(("variable", "allowed", "default", "meaning"), rows)


def _code(value: str) -> str:
    return f"`{value}`" if value else ""
