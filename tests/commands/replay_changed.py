"""Services that are not what they were, to be found out by their references."""

from typing import Any

from palpate_bus.service import Inbox, Outbox
from palpate_control.service import create as create_control
from palpate_models.scenario import Scenario


def weaker(scenario: Scenario) -> Any:
    """A controller that gives one part in a hundred less."""
    service = create_control(scenario)
    honest = service.step

    def step(t: int, inbox: Inbox) -> Outbox:
        out = dict(honest(t, inbox))
        out["control/joint_torque"].torque[:] *= 0.99
        return out

    service.step = step  # type: ignore[method-assign]
    return service


def silent(scenario: Scenario) -> Any:
    """An assessment that says nothing."""
    from palpate_assessment.service import create

    service = create(scenario)
    service.step = lambda t, inbox: {}  # type: ignore[method-assign]
    return service
