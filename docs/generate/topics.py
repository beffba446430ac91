"""docs/topics.md, from the contract."""

from collections.abc import Container, Iterable

from generate import table
from palpate_bus.contract import Contract, Edge, Qos, Role, Visibility, contract as default_contract

_HEAD = """\
# Topics

Generated from [the contract](../bus/palpate_bus/contract/contract.yaml) by `make docs`.

A message is sent on the key `<domain>/<topic>/<type>/<hash>`, as in rmw_zenoh of ROS 2 Jazzy (the domain is `ROS_DOMAIN_ID`,
0 by default), in CDR, with rmw_zenoh's attachment: sequence number, time stamp, GID. In a run with a key, topics marked as tagged
carry [a tag](security.md#without-certificates-the-runs-key) after it. Types of `palpation_msgs` are in
[messages](reference/messages.md). Frames: `world` (on the floor, z up), `abdomen` (origin at the umbilicus, x to the patient's
left, y to the head, z outward). Units are SI, as in REP 103.
"""

_EDGES = {
    Edge.SAME_TICK: "same tick",
    Edge.PREVIOUS: "one period late",
    Edge.LATCHED: "before the first tick",
    Edge.OBSERVE: "on arrival",
}


def page(contract: Contract | None = None) -> str:
    """Return the page of a contract, by default the project's."""
    contract = contract or default_contract()
    senders = {role.name: role for role in contract.roles.values() if contract.outputs(role.name)}
    parts = [_HEAD, _delays(contract), _secrets(contract), _qos(contract.qos.values())]
    parts += [_roles(contract.roles.values(), senders), *(_producer(contract, role) for role in senders.values())]
    parts.append(_internal(contract))
    return "\n".join(parts)


def _delays(contract: Contract) -> str:
    """Return every one-period delay, since users of a co-simulation mistake them for bugs."""
    rows = []
    for topic in contract.topics.values():
        period = contract.roles[topic.producer].period_ms
        readers = [role for role, edge in topic.readers.items() if edge is Edge.PREVIOUS]
        if readers:
            rows.append((f"`{topic.name}`", topic.producer, ", ".join(readers), f"{period} ms"))
    text = (
        "## Delays\n\nAn edge that is one period late lets producer and reader run in parallel: at time T the reader has the"
        " messages sent up to T minus the producer's period. These delays belong to the model, not to the transport:\n\n"
    )
    return text + table(("topic", "from", "to", "delay"), rows)


def _secrets(contract: Contract) -> str:
    rows = [
        (f"`{topic.name}`", topic.visibility.value, topic.producer, ", ".join(topic.readers))
        for topic in contract.topics.values()
        if topic.visibility is not Visibility.PUBLIC
    ]
    text = (
        "## Restricted topics\n\nServices of the examination get only what a real examination could measure; a test checks this."
        "\n\n"
    )
    return text + table(("topic", "kind", "from", "to"), rows)


def _qos(classes: Iterable[Qos]) -> str:
    rows = []
    for qos in classes:
        delivery = f"{qos.reliability}, {qos.congestion} on congestion, {qos.priority}{', express' if qos.express else ''}"
        kept = f"last {qos.depth}{', for late joiners too' if qos.transient_local else ''}"
        rows.append((f"`{qos.name}`", delivery, kept, qos.reason))
    text = (
        "## Quality of service\n\nIn lockstep every edge is reliable and the barrier bounds the messages in flight; a lost"
        " message ends the run.\n\n"
    )
    return text + table(("class", "zenoh", "keeps", "reason"), rows)


def _roles(roles: Iterable[Role], senders: Container[str]) -> str:
    """Return the table of roles; roles that send link to their section."""
    rows = []
    for role in roles:
        kind = "observer: never slows the run" if role.observer else "critical: its loss ends the run" if role.critical else ""
        name = f"[{role.name}](#{role.name})" if role.name in senders else role.name
        rows.append((name, f"{role.period_ms} ms", role.doc, kind))
    return "## Roles\n\n" + table(("role", "steps every", "task", ""), rows)


def _producer(contract: Contract, role: Role) -> str:
    parts = [f"## {role.name}\n", f"{role.doc[0].upper()}{role.doc[1:]}; steps every {role.period_ms} ms.\n"]
    inputs = [(f"`{topic.name}`", topic.producer, _EDGES[edge]) for topic, edge in contract.inputs(role.name)]
    if inputs and not role.observer:
        parts += ["Reads:\n", table(("topic", "from", "when"), inputs)]
    for topic in contract.outputs(role.name):
        parts += [f"### `{topic.name}`\n", topic.doc + ".\n", table(("", ""), topic.facts())]
    return "\n".join(parts)


def _internal(contract: Contract) -> str:
    rows = []
    for row in contract.internal.values():
        every = "" if row.period_ms is None else f"{row.period_ms} ms"
        deadline = "" if row.deadline_ms is None else f"{row.deadline_ms} ms"
        tagged = "yes" if row.tagged else ""
        rows.append((f"`{row.name}`", f"`{row.type}`", row.producer, row.readers, every, deadline, tagged, row.doc))
    head = ("key", "type", "from", "to", "every", "deadline", "tagged", "purpose")
    return "## Messages of the runtime\n\n" + table(head, rows)
