"""What the phases of an examination and its stops share: the arm, the plan, the status, and how a phase is entered or left."""

from __future__ import annotations

from palpate_planning.contact import ContactMeasurement
from palpate_planning.free_motion import FreeMotion
from palpate_planning.palpation import Palpation
from palpate_planning.periods import SECOND
from palpate_planning.status import OVER, ExamStatus, Observation, Phase
from palpate_planning.strokes.plan import ExamPlan, PerceivedAbdomen

END_AFTER = SECOND
"""The run goes on for this long after the examination has ended [ns]."""


class ExamCourse:
    """Where the examination stands and what it has so far."""

    def __init__(self, arm: FreeMotion) -> None:
        self.arm = arm
        self.status = ExamStatus()
        self.since = 0
        """When the phase was entered, or the arm came to rest in it [ns]."""
        self.interrupted = Phase.HOME
        """The phase in which the examination was held last."""
        self.contact: ContactMeasurement
        """Measured at this step."""
        self.rate = 1.0
        """Samples of a trajectory to advance by at this step; see `RestartRamp`."""
        self.perceived: PerceivedAbdomen | None = None
        self.plan: ExamPlan | None = None
        self.palpation: Palpation | None = None
        self.failure = ""
        """Why the examination ends early once the arm is home; empty when all is well."""

    @property
    def phase(self) -> Phase:
        """The phase now."""
        return self.status.phase

    def enter(self, phase: Phase, t: int, message: str) -> None:
        """Enters a phase at `t` [ns]."""
        self.status.phase, self.status.message = phase, message
        self.since = t
        if phase in OVER:
            self.status.end_tick = t + END_AFTER

    def abort(self, now: Observation, why: str) -> None:
        """Ends the examination where the arm is; it holds still."""
        assert now.reading is not None
        self.arm.hold(now.reading.q)
        phase = self.interrupted if self.phase is Phase.HELD else self.phase
        self.enter(Phase.ABORTED, now.t, f"aborted in phase {phase.name}: {why}")

    def go_home(self, now: Observation, why: str) -> None:
        """Returns home from where the arm is; with a reason in `why` the examination then ends early."""
        assert now.reading is not None
        self.failure = why
        self.arm.hold(now.reading.q)
        self.enter(Phase.RETURN, now.t, f"returning home: {why}" if why else "returning home")
