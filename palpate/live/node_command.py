"""`palpate node list`: the nodes on the bus."""

from __future__ import annotations

import typer

from palpate.live.options import AsJson, ChosenBus, ChosenRun, Connect, Domain

app = typer.Typer(help="Nodes on a live bus.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Nodes on a live bus."""


@app.command("list")
def list_nodes(connect: Connect = None, run: ChosenRun = None, domain: Domain = None, as_json: AsJson = False) -> None:
    """List the nodes on the bus, with what each publishes and subscribes to, and the roles that are missing."""
    from palpate.live import graph
    from palpate.live.connection import command, joined
    from palpate.live.console import console, print_json, table
    from palpate_bus.contract import contract

    with command(), joined(ChosenBus(connect, run, domain)) as bus:
        found = graph.present(bus)
        nodes, rules = graph.nodes(found), contract()
        absent = graph.missing(rules, found, bus.target.run)
        if as_json:
            rows = [
                {"node": n.name, "role": n.name in rules.roles, "sessions": sorted(n.zids), "publishes": sorted(n.publishes),
                 "subscribes": sorted(n.subscribes), "services": sorted(n.services)}
                for n in nodes.values()
            ]  # fmt: skip
            print_json({"nodes": rows, "missing": absent})
            return
        out = table("node", "what", ">publishes", ">subscribes", "session")
        for node in nodes.values():
            role = rules.roles.get(node.name)
            what = role.doc if role is not None else "[dim]not a role of the contract[/]"
            out.add_row(node.name, what, str(len(node.publishes)), str(len(node.subscribes)), " ".join(sorted(node.zids)))
        console().print(out)
        if absent:
            console().print(f"[dim]not there: {', '.join(absent)}[/]")
