"""The contract: every role and every topic of the bus, and whether messages keep to it."""

from palpate_bus.contract.rows import (
    MS,
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

__all__ = ["MS", "Contract", "Edge", "Internal", "Qos", "Role", "Topic", "Visibility", "contract", "parse", "with_periods"]
