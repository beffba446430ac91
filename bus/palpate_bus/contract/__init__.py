"""The contract: every role and topic of the bus, and checks of messages against it."""

from palpate_bus.contract.rows import Contract, Edge, Internal, Qos, Role, Topic, Visibility, contract, parse, with_periods

__all__ = ["Contract", "Edge", "Internal", "Qos", "Role", "Topic", "Visibility", "contract", "parse", "with_periods"]
