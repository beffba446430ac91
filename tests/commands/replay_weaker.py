"""A controller that is not what it was, to be found out by its reference."""

from typing import Any

from palpate_bus.service import Inbox, Outbox
from palpate_control.service import create as create_control
from palpate_models.scenario.schema import Scenario


def create(scenario: Scenario) -> Any:
    """A controller that gives one part in a hundred less."""
    service = create_control(scenario)
    honest = service.step

    def step(t: int, inbox: Inbox) -> Outbox:
        out = dict(honest(t, inbox))
        out["control/joint_torque"].torque[:] *= 0.99
        return out

    service.step = step  # type: ignore[method-assign]
    return service
