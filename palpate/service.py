"""The main of every service process: `python -m palpate.service ROLE [NAME_OR_FILE]`.

NAME_OR_FILE is an implementation or a user-defined file, see `palpate_bus.implementations`; by default the scenario's
`services.ROLE` says which. The settings of the run are read from the environment, see `palpate_bus.settings`.
"""

import sys

from palpate_bus.contract import contract

MODULE = "palpate.service"


def command(role: str, *words: str) -> tuple[str, ...]:
    """Return the command of a service process; `words` has the implementation, if any."""
    return ("python", "-m", MODULE, role, *words)


def main(arguments: list[str]) -> None:
    """Run the service to its end and exit with status 0, or 3 if the run failed or was aborted."""
    from palpate_bus.run import load_service, run_service  # noqa: PLC0415 - commands that only start services need neither
    from palpate_models.scenario.load import load_scenario  # noqa: PLC0415

    if not arguments or arguments[0] not in contract().served:
        sys.exit(f"usage: python -m {MODULE} ROLE [NAME_OR_FILE]; ROLE is one of {', '.join(contract().served)}")
    role, *words = arguments
    run_service(role, lambda: load_service(role, load_scenario, words[:1]))


if __name__ == "__main__":
    main(sys.argv[1:])
