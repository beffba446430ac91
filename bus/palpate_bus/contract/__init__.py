"""The contract: every role and topic of the bus, and checks of messages against it."""

from palpate_bus.contract.rows import (
    CONDUCTOR,
    Contract,
    Edge,
    Internal,
    Qos,
    Role,
    Topic,
    Visibility,
    contract,
    parse,
    with_periods,
)

__all__ = ["CONDUCTOR", "Contract", "Edge", "Internal", "Qos", "Role", "Topic", "Visibility", "contract", "parse", "with_periods"]
