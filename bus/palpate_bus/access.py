"""zenoh's access control from the contract, for a router: each role may send what it produces and get what it reads, no more.

    python -m palpate_bus.access > access.json5      # the `access_control` part of zenohd's configuration

A role is a zenoh user of its name (`transport/auth/usrpwd` with a dictionary file; keep that file out of the repository). Peers
that talk directly do not pass the router, so let services be clients of it (`PALPATE_MODE=client`) where this must hold.
"""

from __future__ import annotations

import json
import sys
from typing import Any

from palpate_bus.contract import Contract, Visibility, contract
from palpate_bus.liveliness import ADMIN_SPACE

_SEND = ["put", "delete", "reply", "declare_queryable", "liveliness_token"]
_RECEIVE = ["declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber"]


def access_control(rules: Contract) -> dict[str, Any]:
    """The value of `access_control` in a router's configuration.

    To the router a message that a role sends is an ingress and one that it gets an egress; for a declared subscription or a
    query it is the other way round. Runtime messages and liveliness tokens are everyone's.
    """
    shared = [key for row in rules.internal.values() for key in _keys(row.name.replace("<role>", "*"))]
    shared += [f"{ADMIN_SPACE}/**", "palpate_alive/**"]
    parts: list[dict[str, Any]] = [
        _rule("shared", shared, [*_SEND, *_RECEIVE], ["ingress", "egress"]),
    ]
    policies = []
    for role in rules.roles:
        sends = [key for topic in rules.outputs(role) for key in _keys(topic.name)]
        gets = [key for topic, _ in rules.inputs(role) for key in _keys(topic.name)]
        mine = []
        if sends:
            mine += [_rule(f"{role} sends", sends, _SEND, ["ingress"]), _rule(f"{role} is asked", sends, _RECEIVE, ["egress"])]
        if gets:
            mine += [_rule(f"{role} gets", gets, _SEND, ["egress"]), _rule(f"{role} asks", gets, _RECEIVE, ["ingress"])]
        parts += mine
        policies.append({"rules": ["shared", *(part["id"] for part in mine)], "subjects": [role]})
    seen = [topic.name for topic in rules.topics.values() if topic.visibility is Visibility.PUBLIC]
    public = [key for name in seen for key in _keys(name)]
    parts += [_rule("viewer gets", public, _SEND, ["egress"]), _rule("viewer asks", public, _RECEIVE, ["ingress"])]
    policies.append({"rules": ["viewer gets", "viewer asks"], "subjects": [VIEWER]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": parts,
        "subjects": [{"id": user, "usernames": [user]} for user in (*rules.roles, VIEWER)],
        "policies": policies,
    }


VIEWER = "viewer"
"""A user who may read every public topic and send nothing: a guest's RViz or Foxglove."""


def _keys(topic: str) -> list[str]:
    """Keys of a topic in any domain: of its messages, and of what zenoh's advanced publishers add for latched ones."""
    return [f"*/{topic}/*/*", f"*/{topic}/*/*/@adv/**"]


def _rule(name: str, keys: list[str], messages: list[str], flows: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": flows, "messages": messages, "key_exprs": keys}


if __name__ == "__main__":
    json.dump({"access_control": access_control(contract())}, sys.stdout, indent=2)
    print()
