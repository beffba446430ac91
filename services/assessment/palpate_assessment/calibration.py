"""Parameters fitted to tuning patients: `calibration.yaml`, made by `python -m research.assessment_calibration`."""

from functools import cache
from importlib.resources import files

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict

from palpate_models.numerics.frames import Array


class Calibration(BaseModel):
    """Constants of the regression, and of a candidate's probability."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    exponent: float
    """n of F ~ depth^n around the examination's depth."""
    exponent_sd: float
    """Its SD between people."""
    conversion: float
    """Log of the ratio of sliding force at the depth of the press to the force of the press."""
    conversion_sd: float
    """Its SD between people, tissues, speeds and indenters; presses held before slides determine the patient's own."""
    held: float
    """Log of the ratio of held presses to the standard press, against the slides near them: beyond their wake, too, slides are
    a little weaker than elsewhere."""
    lead_s: float
    """A sliding indenter feels this much of its travel ahead [s]."""
    probability: tuple[float, ...]
    """Weights of a candidate's features (`detection.FEATURES`) in the logit of its probability, the constant first."""
    guarding: tuple[float, float, float]
    """Weights of the signs of a tensed muscle (`guarding.Signs`) in its log odds against everything except a lump, the constant
    first."""
    ridge: tuple[float, float, float, float]
    """Weights of the evidence for a ridge (`Candidate.structures`) in its log odds against a lump, the constant first."""
    bone: tuple[float, float, float, float, float]
    """Weights of the evidence for bone in its log odds against a lump, the constant first."""
    soft: tuple[float, float, float, float]
    """Weights of the evidence for a soft defect in its log odds against a lump, the constant first."""
    prevalence: float
    """Share of the patients of the fit who have a lump that can be felt."""
    tail: tuple[float, float]
    """Location and scale of a healthy examination's maximum logit: P(max > s) = exp(-(s - location) / scale)."""

    def logit(self, features: Array) -> Array:
        """Logits of the probability of candidates with `features`, shape (k, f) -> (k,)."""
        return np.asarray(self.probability[0] + features @ np.array(self.probability[1:]))

    def muscle(self, features: Array) -> Array:
        """The logarithm of how much more probable a tensed muscle is than nothing, of signs' `features`, shape (k, 2) -> (k,)."""
        return np.asarray(self.guarding[0] + features @ np.array(self.guarding[1:]))

    def structures(self, evidence: Array) -> Array:
        """Logs of how much more probable a ridge, bone and a soft defect are than a lump, of `evidence` (k, 10) -> (k, 3)."""
        parts = ((self.ridge, evidence[:, :3]), (self.bone, evidence[:, 3:7]), (self.soft, evidence[:, 7:]))
        return np.column_stack([weights[0] + of @ np.array(weights[1:]) for weights, of in parts])

    def threshold(self, false_findings: float) -> float:
        """Return the logit that a healthy examination exceeds with the probability `false_findings`."""
        location, scale = self.tail
        return float(location - scale * np.log(false_findings))


@cache
def load_calibration() -> Calibration:
    """Return the calibration of this version."""
    return Calibration.model_validate(yaml.safe_load(files(__package__).joinpath("calibration.yaml").read_text("utf-8")))
