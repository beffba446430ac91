"""What the driver has to know of the ROS side, from the environment.

| variable | default | meaning |
|---|---|---|
| `PALPATE_LBR_ROUTER` | `tcp/127.0.0.1:7447` | zenoh endpoint of the ROS side: its rmw_zenohd, or the emulator |
| `PALPATE_LBR_DOMAIN` | 0 | ROS domain of the ROS side |
| `PALPATE_LBR_NAMESPACE` | `lbr` | the stack's `robot_name`, which is its namespace too |
| `PALPATE_LBR_FT_TOPIC` | `ft_sensor/wrench` | topic of the F/T sensor's driver, geometry_msgs/WrenchStamped |
| `PALPATE_LBR_FT_SIGN` | 1 | -1 when that driver reports what the sensor exerts on the tool |
| `PALPATE_LBR_FT_YAW_DEG` | 0 | turn of the sensor's x axis about the flange's z |
| `PALPATE_LBR_LEVEL` | `torque` | `setpoint`: the law runs in the driver's process; `control/joint_torque` is passed over |
| `PALPATE_LBR_EMULATED` | 0 | 1: exchange what only physics knows with the emulator, for simulated tissue and camera |
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

LEVELS: Final = ("torque", "setpoint")


class SettingsError(ValueError):
    """A variable that cannot be used. Names it, its value and what is allowed."""


@dataclass(frozen=True)
class Settings:
    """See the module's table."""

    router: str = "tcp/127.0.0.1:7447"
    domain: int = 0
    namespace: str = "lbr"
    ft_topic: str = "ft_sensor/wrench"
    ft_sign: float = 1.0
    ft_yaw_deg: float = 0.0
    level: str = "torque"
    emulated: bool = False

    @classmethod
    def from_env(cls, environ: Mapping[str, str] = os.environ) -> Settings:
        """Reads the variables. Raises SettingsError."""
        level = environ.get("PALPATE_LBR_LEVEL") or cls.level
        if level not in LEVELS:
            raise SettingsError(f"PALPATE_LBR_LEVEL is {level!r}; allowed are {', '.join(LEVELS)}")
        sign = _number(environ, "PALPATE_LBR_FT_SIGN", cls.ft_sign)
        if sign not in (1.0, -1.0):
            raise SettingsError(f"PALPATE_LBR_FT_SIGN is {sign:g}; allowed are 1 and -1")
        return cls(
            router=environ.get("PALPATE_LBR_ROUTER") or cls.router,
            domain=int(_number(environ, "PALPATE_LBR_DOMAIN", cls.domain)),
            namespace=(environ.get("PALPATE_LBR_NAMESPACE") or cls.namespace).strip("/"),
            ft_topic=(environ.get("PALPATE_LBR_FT_TOPIC") or cls.ft_topic).strip("/"),
            ft_sign=sign,
            ft_yaw_deg=_number(environ, "PALPATE_LBR_FT_YAW_DEG", cls.ft_yaw_deg),
            level=level,
            emulated=environ.get("PALPATE_LBR_EMULATED", "0") == "1",
        )


def _number(environ: Mapping[str, str], name: str, default: float) -> float:
    text = environ.get(name)
    if not text:
        return default
    try:
        return float(text)
    except ValueError:
        raise SettingsError(f"{name} is {text!r}; want a number") from None
