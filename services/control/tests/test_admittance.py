"""Admittance control: the static law, the tare, and the limits of what it commands."""

from __future__ import annotations

import numpy as np
import pytest
from control_plant import WORKING, reference, setpoint

from palpate_bus.setpoint import ControlMode
from palpate_control.admittance import TUNING, AdmittanceController
from palpate_control.model import ArmModel
from palpate_models.numerics.frames import GRAVITY
from palpate_models.robot.arm import urdf
from palpate_models.scenario.schema import Robot

MASS = 0.35
BIAS = np.array((1.5, -2.0, 3.0))
REST = np.zeros(7)


class Contact:
    """A controller that has learned the bias of its sensor in free motion, and an arm that does what it commands."""

    def __init__(self, q: np.ndarray = WORKING[1]) -> None:
        self.model = ArmModel(urdf(Robot()))
        self.law, self.q = AdmittanceController(self.model, MASS), np.array(q)
        self.start = self.follow(1000, ControlMode.JOINT, np.zeros(3))

    def follow(self, ticks: int, mode: ControlMode, force_W: np.ndarray, **changes: object) -> np.ndarray:
        """Return where the tool is after some ticks under a force on it."""
        asked = reference(setpoint(self.model, self.asked, mode=mode, **changes)) if ticks else None
        for _ in range(ticks):
            self.model.update_kinematics(self.q)
            self.law.sense(self.model.R_WI.T @ (force_W - (0, 0, MASS * GRAVITY)) + BIAS)
            self.q = self.law.command(self.q, REST, asked)
        self.model.update_kinematics(self.q)
        return self.model.p_WI.copy()

    @property
    def asked(self) -> np.ndarray:
        return WORKING[1]
