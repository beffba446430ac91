"""Message classes: `from palpate_bus.messages import JointState`.

They are made from .msg files when this module is imported; `__init__.pyi`, which `stubs.py` writes, tells type checkers their
fields. `names.py` lists them.
"""

from palpate_bus.messages.names import TYPE_NAMES
from palpate_bus.messages.typestore import message_type

globals().update({short: message_type(name) for short, name in TYPE_NAMES.items()})
