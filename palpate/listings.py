"""`palpate scenarios` and `palpate topics`: lists of scenarios and topics."""

from typing import Annotated

import typer
from rich.text import Text

from palpate.console import SteadyConsole, print_line, table, wide_console


def scenarios(as_json: Annotated[bool, typer.Option("--json", help="Print them as JSON.")] = False) -> None:
    """List the scenarios that come with Palpate."""
    from palpate_models.scenario.load import load_scenario, scenario_names

    if as_json:
        print_line([load_scenario(name).model_dump(mode="json") for name in scenario_names()])
        return
    rows = table("scenario", "lesions", "description")
    for name in scenario_names():
        scenario = load_scenario(name)
        rows.add_row(name, str(len(scenario.phantom.lesions)), scenario.description)
    SteadyConsole().print(rows)


def topics() -> None:
    """Show the contract: every topic with type, rate, who writes and who reads it."""
    from palpate_bus.contract import contract

    rows = table("topic", "type", "producer", "period", "QoS", "hashed", "readers")
    for topic in contract().topics.values():
        rows.add_row(
            topic.name if topic.visibility == "public" else Text.assemble(topic.name, (f" ({topic.visibility})", "dim")),
            topic.type.replace("/msg/", "/"),
            topic.producer,
            topic.sent,
            topic.qos,
            "yes" if topic.hashed else "",
            ", ".join(f"{role} ({edge})" for role, edge in topic.readers.items() if edge.blocking),
        )
    wide_console(160).print(rows)
