"""Message classes, and their stamps: `from palpate_bus.messages import JointState, header`.

They are created from .msg files when this module is imported. `typestore.py` lists them;
`__init__.pyi`, written by `bus/tests/message_stubs.py`, declares their fields for type checkers.
"""

from palpate_bus.messages.typestore import TYPE_NAMES, message_type

globals().update({short: message_type(name) for short, name in TYPE_NAMES.items()})

from palpate_bus.messages.codec import CodecError, Message  # after the classes, which these modules need
from palpate_bus.messages.stamps import MS, NS, UNIX_NS, blank, duration_message, header, nanoseconds, time_message
