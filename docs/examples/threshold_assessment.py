"""An assessment: places with more than twice the force of the softest tenth are stiff."""

import numpy as np

from palpate_bus.messages import ExamState, Finding, Findings, Point, header
from palpate_bus.service import Service
from palpate_models.numerics.frames import apply, inverse
from palpate_models.scenario.load import exam_input
from palpate_models.section import quadrant


class Threshold(Service):
    """Force at depth divided by that of the softest places."""

    role = "assessment"

    def __init__(self, exam):
        self.X_AW, self.spacing = inverse(np.array(exam.X_WA)), exam.exam.spacing_m
        self.places, self.forces, self.done = [], [], False

    def step(self, t, inbox):
        """Collect samples; publish the findings when the scan is over."""
        for state in inbox.new("exam/state"):
            if state.steady:  # in contact, at depth
                point = state.surface_point
                self.places.append((point.x, point.y, point.z))
                self.forces.append(state.normal_force)
            if state.phase in (ExamState.PHASE_ASSESS, ExamState.PHASE_ABORTED) and not self.done:
                self.done = True
                findings = Findings(header(t, "abdomen"), self.findings(), [], final=True)
                return {"assessment/findings": findings}
        return {}

    def findings(self):
        """Return one finding: all places with more than twice the force of the softest tenth."""
        if not self.forces:
            return []
        places = apply(self.X_AW, np.array(self.places))
        ratio = np.array(self.forces) / np.quantile(self.forces, 0.1)
        stiff = places[ratio > 2.0]
        if not len(stiff):
            return []
        x, y, z = map(float, stiff.mean(axis=0))
        level = float(np.median(ratio[ratio > 2.0]))
        area = self.spacing**2 * len(np.unique(np.round(stiff[:, :2] / self.spacing), axis=0))
        others = {"guarding": 0.0, "ridge": 0.0, "bone": 0.0, "soft": 0.0}
        ratio = {"ratio": level, "ratio_lower": 2.0, "ratio_upper": float(ratio.max())}
        place = {"centroid": Point(x, y, z), "quadrant": quadrant(x, y), "area": area}
        return [Finding(**place, **ratio, confidence=0.5, **others, kind=Finding.KIND_LUMP)]


def create(scenario):
    """Return the service of a scenario."""
    return Threshold(exam_input(scenario))
