"""A denied attempt on a secure bus is one of the doctor's findings."""

from __future__ import annotations

import socket
import time
from pathlib import Path

from palpate.live.doctor import Remark, Severity, turned_away
from palpate_bus.contract import contract
from palpate_bus.security.access import ROUTER, VIEWER
from palpate_bus.security.guard import Guard
from palpate_bus.security.keys import init
from palpate_bus.wire.rmw import topic_key
from palpate_bus.wire.zenoh_config import BusOptions, session


def test_a_torque_by_the_cameras_certificate_shows(tmp_path: Path) -> None:
    keys = tmp_path / "keys"
    init(keys)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tls/127.0.0.1:{probe.getsockname()[1]}"
    torque = topic_key(contract().topics["control/joint_torque"], 0)
    with Guard(keys / ROUTER, endpoint, lambda _: None):
        options = {name: BusOptions(mode="client", router=endpoint, tls=keys / name) for name in ("camera", VIEWER)}
        with session(options["camera"]) as camera, session(options[VIEWER]) as viewer:
            assert turned_away(viewer) == [Remark("access", Severity.OK, "the router turned nobody away")]
            found: list[Remark] = []
            end = time.monotonic() + 20
            while time.monotonic() < end and not any(finding.level is Severity.BAD for finding in found):
                camera.put(torque, b"x")
                found = turned_away(viewer)
    (finding,) = found
    assert "camera" in finding.text
    assert "control/joint_torque" in finding.text
