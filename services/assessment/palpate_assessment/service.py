"""Assessment as a service: states of the examination in; samples, a growing map, the final map and findings out."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
from scipy.interpolate import LinearNDInterpolator

from palpate_assessment.assess import Area, AssessedMap, MapGrid, assess, assess_growing, map_grid
from palpate_assessment.sampling import ContactState, ForceSample, Sampler, SeenBreath, samples_of
from palpate_assessment.standard import USUAL, PressStandard
from palpate_bus.contract import contract
from palpate_bus.contract.port_check import MessageViolation, RefusedMessage, ViolationKind
from palpate_bus.messages import ExamState, Finding, Findings, Message, PalpationSample, Point, StiffnessMap, SurfaceMotion
from palpate_bus.messages.geometry import point_message, vector_message
from palpate_bus.messages.stamps import NS, header, nanoseconds
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.settings import Settings
from palpate_models.numerics.frames import Array, apply, inverse
from palpate_models.scenario.load import Checkpoint, exam_input, read_checkpoint
from palpate_models.scenario.schema import MOTION_NOTICED_S, ExamInput, Following, Scenario
from palpate_models.section import quadrant

DEEPER_MAX_M: Final = 0.01
"""Maximum median change of depth: planning follows the skin to millimetres once it has touched it."""


class KnownSkin:
    """The skin at the end of expiration, in A, as the whole examination shows it.

    Planning counts depth from the skin as it knows it then. When the strokes are over it knows better: by all touches, and by all
    images of the wall. With z(x) the height of that skin, and z' the height from which depth d' was counted at a place of normal
    n,

        d = d' + n_z (z(x) - z').
    """

    def __init__(self, p_A: Array, sigma: Array, since: float) -> None:
        """Points [m], shape (n, 3), with the standard deviation of their height [m], (n,), for what is felt after `since` [s]."""
        self._known = LinearNDInterpolator(p_A[:, :2], np.column_stack((p_A[:, 2], sigma)))
        self._since = since

    def deeper(self, time: Array, position: Array, normal: Array) -> tuple[Array, Array]:
        """Return the correction of the reported depth [m] and its standard deviation [m]; shape (k,) each, NaN where unknown.

        For times [s], points of the skin from which depth is counted [m] and outward normals, shapes (k,), (k, 3), (k, 3).
        """
        height, sigma = self._known(position[:, :2]).T
        there = time >= self._since
        deeper = normal[:, 2] * (height - position[:, 2])
        return np.where(there, deeper, np.nan), np.where(there, sigma, np.nan)

    def middle_change(self, samples: Sequence[ForceSample]) -> float:
        """Return the median change of depth [m], 0 where the skin is known at no sample."""
        deeper = self._deeper(samples)[0] if samples else np.zeros(1)
        known = deeper[np.isfinite(deeper)]
        return float(np.median(known)) if len(known) else 0.0

    def again(self, samples: Sequence[ForceSample]) -> list[ForceSample]:
        """Return the samples with their depths from this skin, where it is known."""
        if not samples:
            return []
        deeper, sigma = self._deeper(samples)
        return [
            sample if np.isnan(by) else sample._replace(depth=sample.depth + float(by), depth_uncertainty=float(s))
            for sample, by, s in zip(samples, deeper, sigma, strict=True)
        ]

    def _deeper(self, samples: Sequence[ForceSample]) -> tuple[Array, Array]:
        columns = ([sample.time for sample in samples], [s.position for s in samples], [s.normal for s in samples])
        return self.deeper(*map(np.array, columns))


FRAME = contract().topics["assessment/map"].frame or ""


class MapTuning(NamedTuple):
    """Grids of the maps, and when a map of the growing samples is made."""

    pitch_m: float = 0.005
    """Pitch of the final map's grid [m]: a third of the radius in which the indenter feels."""
    margin_m: float = 0.020
    """The map's grid goes this far beyond the examined region [m]: so far a place is felt."""
    growing_pitch_m: float = 0.008
    growing_samples: int = 200
    """A growing map takes every n-th sample, so that it stays cheap."""
    growing_period_ns: int = 6 * NS
    growing_first: int = 40
    """Samples before the first growing map."""


MAP = MapTuning()
RESENT_PER_STEP = 50
"""Samples of an earlier examination that are published in one step."""
SCANNING = frozenset({ExamState.PHASE_INDENT, ExamState.PHASE_SCAN, ExamState.PHASE_RETRACT})
FINISHED = frozenset({ExamState.PHASE_ASSESS, ExamState.PHASE_DONE, ExamState.PHASE_ABORTED})


SEEN = frozenset({SurfaceMotion.QUIET, SurfaceMotion.SPOILED})
"""States of `perception/motion` in which the wall was seen, and where it was expected."""


class AssessmentService(Service):
    """Thins the measured states to samples and turns them into a stiffness map and findings."""

    role: ClassVar[str] = "assessment"

    def __init__(self, exam: ExamInput, before: Checkpoint | None = None) -> None:
        """`before`: checkpoint of an examination that this one continues."""
        self._exam = exam.exam
        self._X_AW = inverse(np.array(exam.X_WA))
        self._R_AW, self._p_AW = self._X_AW[:3, :3], self._X_AW[:3, 3]
        self._reach = float(np.clip(0.8 * exam.exam.spacing_m, 0.006, 0.020))
        self._sampler = Sampler()
        self._breath = SeenBreath()
        self.samples: list[ForceSample] = [] if before is None else samples_of(before.felt)
        """All samples."""
        self._unpublished = list(self.samples)
        """Samples of the earlier examination that this one has not published yet."""
        self._moved_at: float | None = None
        """When the patient was seen to have moved [s]."""
        self._surface: Array | None = None
        self._perceived: Message | None = None
        self._skin: KnownSkin | None = None
        self._correction: Message | None = None
        """Final surface."""
        self._coarse: MapGrid | None = None
        self._last_map = 0
        self._mapped = 0
        self._final: AssessedMap | None = None
        self._finished = False

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Samples as they come, a map every few seconds, and once the scan is over the final map and the findings."""
        phase = None
        new, self._unpublished = self._unpublished[:RESENT_PER_STEP], self._unpublished[RESENT_PER_STEP:]
        others = self._others(inbox)
        for state in inbox.new("exam/state"):
            while others and others[0][0] <= nanoseconds(state.header.stamp):
                _, take, message = others.popleft()
                take(message)
            phase = int(state.phase)
            new += self.take(state)
        for _, take, message in others:
            take(message)
        outbox: dict[str, Message | list[Message]] = {}
        if new:
            outbox["assessment/samples"] = [sample_message(s) for s in new]
        if phase in FINISHED and not self._finished:
            self._finished = True
            outbox |= self._finish(t)
        elif phase in SCANNING and self._due(t):
            outbox |= self._grow(t)
        return outbox

    def _others(self, inbox: Inbox) -> deque[tuple[int, Callable[[Message], None], Message]]:
        """Return messages other than states with their handlers, by stamp [ns]. One step may contain a whole recording."""
        takers: dict[str, Callable[[Message], None]] = {
            "perception/surface": self.perceive,
            "perception/motion": self.add_motion,
            "exam/correction": self.correct,
        }
        came = [(nanoseconds(m.header.stamp), take, m) for topic, take in takers.items() for m in inbox.new(topic)]
        return deque(sorted(came, key=lambda one: one[0]))

    def add_motion(self, motion: Message) -> None:
        """Take the next `perception/motion`."""
        if motion.state in SEEN and self._exam.breathing is not Following.IGNORE:
            self._breath.add_image(nanoseconds(motion.header.stamp) / NS, float(motion.displacement))

    def correct(self, message: Message) -> None:
        """Take the `exam/correction`."""
        if self._perceived is not None:
            self._skin, self._correction = skin_of(self._perceived, message, self._X_AW), message

    def take(self, state: Message) -> list[ForceSample]:
        """Take the next `exam/state`; return the samples that are complete now. The last ones are at the end of the scan."""
        if state.patient_moved:
            self._forget_motion(nanoseconds(state.header.stamp) / NS)
            return []
        self._moved_at = None
        self._breath.take(self._state(state))
        settled = self._breath.take_settled(at_once=state.phase in FINISHED)
        new = [sample for one in settled if (sample := self._sampler.add(one)) is not None]
        self.samples += new
        return new

    def finish(self) -> Mapping[str, Any]:
        """Return the number of samples and findings."""
        final = self._final
        return {
            "samples": len(self.samples),
            "samples_used": 0 if final is None else final.samples,
            "findings": 0 if final is None else len(final.findings),
        }

    def perceive(self, message: Message) -> None:
        """Take a `perception/surface`. Raises ValueError for one in another frame than the contract's."""
        wanted = contract().topics["perception/surface"].frame
        if message.header.frame_id != wanted:
            raise ValueError(f"perception/surface: header.frame_id = {message.header.frame_id!r}, expected {wanted!r}")
        self._perceived, self._skin = message, None
        p_A = apply(self._X_AW, np.asarray(message.vertices, dtype=np.float64).reshape(-1, 3))
        if self._surface is not None and self.samples:
            return  # a scan after the patient moved: samples refer to the first scan, so its shares stay valid
        self._surface = p_A
        self._breath.perceive(p_A, np.asarray(message.breathing, dtype=np.float64))
        self._coarse = self._grid(MAP.growing_pitch_m)

    def _grid(self, pitch: float) -> MapGrid:
        assert self._surface is not None
        return map_grid(self._surface, self._exam.centre_m, self._exam.region_m, MAP.margin_m, pitch)

    def _state(self, message: Message) -> ContactState:
        p, n = message.surface_point, message.surface_normal
        return ContactState(
            time=nanoseconds(message.header.stamp) / NS,
            position=self._R_AW.dot((p.x, p.y, p.z)) + self._p_AW,
            normal=self._R_AW.dot((n.x, n.y, n.z)),
            depth=float(message.depth),
            force=float(message.normal_force),
            in_contact=bool(message.in_contact),
            counts=bool(message.steady),
            force_limited=bool(message.force_limited),
            stroke=int(message.stroke),
            depth_uncertainty=float(message.depth_uncertainty),
            followed=float(message.wall_displacement),
        )

    def _forget_motion(self, t: float) -> None:
        """The patient was seen to have moved at `t` [s]: what was felt just before, and is felt from now on, lies elsewhere."""
        if self._moved_at is None:
            self._moved_at = t
            self._breath.forget()
            self._sampler.forget()
            self.samples = [sample for sample in self.samples if sample.time < t - MOTION_NOTICED_S]

    def _due(self, t: int) -> bool:
        grown = len(self.samples) >= max(MAP.growing_first, self._mapped + 10)
        return grown and self._coarse is not None and t - self._last_map >= MAP.growing_period_ns

    def _grow(self, t: int) -> Outbox:
        assert self._coarse is not None
        self._last_map, self._mapped = t, len(self.samples)
        every = -(-len(self.samples) // MAP.growing_samples)
        chosen = self.samples[::every]
        result = assess_growing(chosen, self._coarse, self._reach)
        return {} if result is None else {"assessment/map": map_message(t, result, self._exam.depth_m)}

    def _finish(self, t: int) -> Outbox:
        if self._skin is not None and self._correction is not None:
            if abs(change := self._skin.middle_change(self.samples)) > DEEPER_MAX_M:
                expected = f"within {1e3 * DEEPER_MAX_M:.0f} mm of where the strokes counted their depth"
                wrong = MessageViolation(ViolationKind.RANGE, "outward", expected, f"{1e3 * change:.0f} mm from there")
                raise RefusedMessage(contract().topics["exam/correction"], wrong, self._correction)
            self.samples = self._skin.again(self.samples)
        if self._surface is not None:
            self._final = assess(
                self.samples,
                self._grid(MAP.pitch_m),
                self._reach,
                self._exam.false_findings,
                prevalence=self._exam.prevalence,
                marked=self._exam.marked,
            )
        if self._final is None:
            return {"assessment/findings": findings_message(t, [], [])}
        return {
            "assessment/map": map_message(t, self._final, self._exam.depth_m),
            "assessment/findings": findings_message(t, self._final.findings, self._final.candidates),
        }


def create(scenario: Scenario) -> Service:
    """Return the assessment of a scenario; it knows nothing of the phantom but where the patient is registered."""
    return AssessmentService(exam_input(scenario), read_checkpoint(Settings.read().checkpoint))


def skin_of(perceived: Message, correction: Message, X_AW: Array) -> KnownSkin | None:
    """Return the skin by `perception/surface` and `exam/correction`; None where one is not of the other. `X_AW`: shape (4, 4)."""
    p_W, n_W = (np.asarray(values, dtype=np.float64).reshape(-1, 3) for values in (perceived.vertices, perceived.normals))
    outward, sigma = (np.asarray(values, dtype=np.float64) for values in (correction.outward, correction.uncertainty))
    if not len(p_W) == len(n_W) == len(outward) == len(sigma):
        return None
    p_A = apply(X_AW, p_W + outward[:, np.newaxis] * n_W)
    return KnownSkin(p_A, sigma, nanoseconds(perceived.header.stamp) / NS)


def sample_message(sample: ForceSample) -> Message:
    """`palpation_msgs/PalpationSample`, stamped with the middle of the measurement."""
    return PalpationSample(
        header=header(round(sample.time * NS), FRAME),
        position=point_message(sample.position),
        normal=vector_message(sample.normal),
        depth=sample.depth,
        normal_force=sample.force,
        tangential_speed=float(np.linalg.norm(sample.velocity)),
        time_in_contact=sample.time_in_contact,
        force_limited=sample.force_limited,
        stroke=sample.stroke,
        depth_uncertainty=sample.depth_uncertainty,
    )


def map_message(t: int, result: AssessedMap, common_depth: float, standard: PressStandard = USUAL) -> Message:
    """`palpation_msgs/StiffnessMap`: its force is what sliding at `common_depth` [m] would feel."""
    calibration = standard.calibration
    sliding = float(np.exp(calibration.conversion) * (common_depth / standard.depth_m) ** calibration.exponent)
    finding = np.full(len(result.apparent), -1, dtype=np.int32)
    for i, area in enumerate(result.findings):
        finding[area.nodes] = i
    return StiffnessMap(
        header=header(t, FRAME),
        vertices=result.grid.nodes.astype(np.float32).reshape(-1),
        triangles=result.grid.triangles.reshape(-1),
        apparent=result.apparent.astype(np.float32),
        lower=result.lower.astype(np.float32),
        upper=result.upper.astype(np.float32),
        force=(result.apparent * sliding).astype(np.float32),
        stiffness=np.empty(0, dtype=np.float32),
        scanned=result.unassessed != StiffnessMap.NOT_REACHED,
        unassessed=result.unassessed,
        finding=finding,
        common_depth=common_depth,
        background=result.background,
        samples=result.samples,
    )


def findings_message(t: int, findings: Sequence[Area], candidates: Sequence[Area]) -> Message:
    """`palpation_msgs/Findings`, the final ones, and the candidates."""
    reported, weighed = ([finding_message(area) for area in some] for some in (findings, candidates))
    return Findings(header=header(t, FRAME), findings=reported, candidates=weighed, final=True)


def finding_message(area: Area) -> Message:
    """`palpation_msgs/Finding`."""
    x, y, z = map(float, area.centroid)
    lump, muscle, ridge, bone, soft = area.kinds.tolist()
    return Finding(
        centroid=Point(x, y, z),
        quadrant=quadrant(x, y),
        area=area.area,
        ratio=area.ratio,
        ratio_lower=area.ratio_lower,
        ratio_upper=area.ratio_upper,
        confidence=lump,
        guarding=muscle,
        ridge=ridge,
        bone=bone,
        soft=soft,
        kind=int(area.kinds.argmax()),
    )
