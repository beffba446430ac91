"""zenoh's access control for a router, from the contract: a role may send its outputs and receive its inputs, nothing else.

    python -m palpate_bus.security.access > access.json5      # the `access_control` part of zenohd's configuration

A member is identified by the common name of its certificate (`keys.py`), or with `--users` by its zenoh user name
(`transport/auth/usrpwd` with a dictionary file; keep that file out of the repository). Messages between peers do not pass the
router, so in a secure run (`palpate run --secure`) services are its clients (`PALPATE_MODE=client`).

The rules derived from the contract: the producer of a topic may send it and its readers may receive it, including the history of
latched topics and queries for it; only the conductor sends control messages (grants, the end); a role sends its own reports and
chunks, which only the conductor and the recorder receive; a role declares liveliness tokens of its own node, which all members
may read. Anything else is denied.
"""

import json
import sys
from collections.abc import Sequence
from typing import Any

from palpate_bus.contract import CONDUCTOR, Contract, Visibility, contract
from palpate_bus.wire.liveliness import ADMIN_SPACE
from palpate_bus.wire.rmw import hello_key

VIEWER = "viewer"
"""A member that may read every public topic and send nothing: RViz, Foxglove, or `palpate doctor`."""
OPERATOR = "operator"
"""A viewer that may also stop and release: `palpate stop` asks the conductor, which forwards the request."""
ROUTER = "router"
"""Certificate of the router; it may send and receive nothing."""
OPERATOR_REQUESTS = "*/palpate/operator"
"""Key of operator requests to the conductor, in any domain."""

_VIEWED = ("palpate/control", "palpate/report/*")
"""Messages of the runtime that a viewer may receive: progress of the services."""

_PUT = ["put", "delete", "reply", "declare_queryable"]
_GET = ["declare_subscriber", "query"]
_TOKEN = ["liveliness_token"]
_WATCH = ["liveliness_query", "declare_liveliness_subscriber"]


class _Rules:
    """Collects rules and the members that they apply to."""

    def __init__(self) -> None:
        self.rules: list[dict[str, Any]] = []
        self.policies: dict[str, list[str]] = {}

    def allow(self, who: str, what: str, keys: Sequence[str], sends: bool, messages: tuple[list[str], list[str]]) -> None:
        """Allow `who` to send on `keys`, or to receive from them.

        For the router, a message sent by a member is an ingress and a received one an egress; for subscriptions and queries it
        is the reverse. `messages`: the kinds that pass from sender to receiver, and those that pass back. `what` names the rule.
        """
        forward, reverse = ("ingress", "egress") if sends else ("egress", "ingress")
        for flow, kinds in ((forward, messages[0]), (reverse, messages[1])):
            name = f"{who} {what} {flow}"
            rule = {"id": name, "permission": "allow", "flows": [flow], "messages": kinds, "key_exprs": list(keys)}
            self.rules.append(rule)
            self.policies.setdefault(who, []).append(name)


def access_control(contract: Contract, by: str = "cert_common_names") -> dict[str, Any]:
    """Return the value of `access_control` in a router's configuration.

    `by`: the attribute that identifies a member in zenoh, `cert_common_names` or `usernames`.
    """
    access = _Rules()
    presence = (_TOKEN, _WATCH)
    data = (_PUT + _TOKEN, _GET + _WATCH)  # an advanced publisher has a token below its key
    internal = list(contract.internal.values())
    for role in contract.roles:
        sends = [key for topic in contract.outputs(role) for key in _keys(topic.name)]
        sends += [key for row in internal if row.producer in ("any", role) for key in _keys(row.name.replace("<role>", role))]
        gets = [key for topic, _ in contract.inputs(role) for key in _keys(topic.name)]
        gets += [key for row in internal if row.readers in ("any", role) for key in _keys(row.name.replace("<role>", "*"))]
        access.allow(role, "sends", sends, True, data)
        access.allow(role, "gets", gets, False, data)
        tokens = [f"{ADMIN_SPACE}/*/*/*/*/*/*/*/{role}/**"]  # of its node, publishers and subscriptions, see `liveliness`
        access.allow(role, "lives", tokens, True, presence)
    shown = public(contract)
    access.allow(CONDUCTOR, "watches", [key for name in shown for key in _keys(name)], False, data)
    for guest in (VIEWER, OPERATOR):
        access.allow(guest, "gets", [key for name in (*shown, *_VIEWED) for key in _keys(name)], False, data)
    access.allow(CONDUCTOR, "serves", [OPERATOR_REQUESTS], True, data)
    access.allow(OPERATOR, "orders", [OPERATOR_REQUESTS], False, data)
    for member in (*contract.roles, VIEWER, OPERATOR):
        access.allow(member, "sees", [f"{ADMIN_SPACE}/**"], False, presence)
    subjects = [{"id": member, by: [member]} for member in access.policies]
    policies = [{"rules": names, "subjects": [member]} for member, names in access.policies.items()]
    members = {"rules": access.rules, "subjects": subjects, "policies": policies}
    return {"enabled": True, "default_permission": "deny", **members}


def list_watched(contract: Contract) -> list[str]:
    """Return the topics that the monitor of a run may receive, in the contract's order."""
    shown = {*public(contract), *(topic.name for topic, _ in contract.inputs(CONDUCTOR))}
    return [name for name in contract.topics if name in shown]


def public(contract: Contract) -> list[str]:
    """Return the public topics, in the contract's order."""
    return [topic.name for topic in contract.topics.values() if topic.visibility is Visibility.PUBLIC]


def _keys(topic: str) -> list[str]:
    """Return the keys of a topic in any domain: messages, hellos, and additions of zenoh's advanced publishers."""
    key = f"*/{topic}/*/*"
    return [key, hello_key(key), f"{key}/@adv/**"]


if __name__ == "__main__":
    by = "usernames" if "--users" in sys.argv[1:] else "cert_common_names"
    print(json.dumps({"access_control": access_control(contract(), by)}, indent=2))
