"""Map and findings of known bellies, signs of a muscle around a lump, and the regression."""

from functools import partial

import numpy as np
import pytest
from assessment_lines import LEVEL, UP, flat_grid, level, lines, lump, natural, observations, regression

from palpate_assessment.assess import AssessedMap, assess, assess_growing, causes, map_grid, marked_share
from palpate_assessment.detection import Candidate, Signs, find_disc, find_rival, limit_strength, match_bumps, signs
from palpate_assessment.model import Regression, fit_log_amplitudes
from palpate_assessment.sampling import ForceSample
from palpate_assessment.shapes import Bump, ridge
from palpate_assessment.standard import LENGTHS, Observations, PressStandard, load_calibration
from palpate_bus.messages import StiffnessMap
from palpate_bus.messages.codes import FindingKind
from palpate_models.scenario.schema import Marked

REACH, FALSE_FINDINGS = 0.010, 0.02


def examine(samples: list[ForceSample], rate: float = FALSE_FINDINGS, marked: tuple[Marked, ...] = ()) -> AssessedMap:
    result = assess(samples, flat_grid(), REACH, rate, marked=marked)
    assert result is not None
    return result


def held(result: AssessedMap, truth: np.ndarray) -> float:
    inside = result.unassessed == StiffnessMap.ASSESSED
    return float(((result.lower <= truth) & (truth <= result.upper))[inside].mean())


def width(result: AssessedMap) -> np.ndarray:
    """Return the log of upper over lower where the map was assessed."""
    return np.log(result.upper / result.lower)[result.unassessed == StiffnessMap.ASSESSED]


@pytest.mark.parametrize("seed", range(2))
def test_natural_variation_under_errors_is_no_finding_and_is_in_the_band(seed: int) -> None:
    wall = natural(seed, 0.15)
    result = examine(lines(lambda xy: LEVEL + wall(xy), seed, stroke_m=0.0007, breathing_m=0.0007))
    assert result.findings == []
    assert held(result, np.exp(LEVEL + wall(result.grid.nodes[:, :2]))) > 0.75


@pytest.mark.parametrize(("contrast", "radius"), [(2.5, 0.02), (4.0, 0.03), (0.3, 0.025)])
def test_a_lump_is_found_where_and_as_it_is(contrast: float, radius: float) -> None:
    centre, wall = (-0.015, 0.01), natural(4, 0.1)
    result = examine(lines(lambda xy: LEVEL + wall(xy) + lump(xy, centre, radius, contrast)))
    (found,) = result.findings
    assert found.kinds.argmax() == FindingKind.LUMP
    assert np.linalg.norm(found.centroid[:2] - centre) < 0.004
    assert found.area == pytest.approx(np.pi * radius**2, rel=0.25)
    truth = lump(result.grid.nodes[found.nodes, :2], centre, radius, contrast)
    assert np.log(found.ratio) == pytest.approx(truth.mean(), abs=0.15)
    assert found.ratio_lower < found.ratio < found.ratio_upper
    # A soft area near the midline may be a defect of the wall.
    assert found.kinds[FindingKind.LUMP] > (0.9 if contrast > 1 else 0.6)


def test_two_lumps_are_two_findings() -> None:
    result = examine(lines(lambda xy: LEVEL + lump(xy, (-0.04, -0.03), 0.02, 4.0) + lump(xy, (0.04, 0.03), 0.02, 4.0)))
    assert len(result.findings) == 2


def test_errors_of_strokes_widen_the_band() -> None:
    exact, wrong = (examine(lines(level, stroke_m=error)) for error in (0.0, 0.001))
    assert np.median(width(wrong)) > 1.2 * np.median(width(exact))


def test_a_lower_rate_of_false_findings_reports_less() -> None:
    wall, found = natural(3, 0.1), {1e-4: 0, 0.5: 0}
    for contrast in (1.2, 1.35, 1.5):
        bump = partial(lump, centre=(0.0, 0.0), radius=0.02, contrast=contrast)
        samples = lines(lambda xy, bump=bump: LEVEL + wall(xy) + bump(xy), stroke_m=0.0007, breathing_m=0.0007)
        results = {rate: examine(samples, rate) for rate in found}
        assert len({len(result.findings + result.candidates) for result in results.values()}) == 1
        found = {rate: count + len(results[rate].findings) for rate, count in found.items()}
    assert found[1e-4] < found[0.5]


def test_a_stroke_piece_that_the_others_contradict_is_not_assessed() -> None:
    def spoiled(sample: ForceSample) -> ForceSample:
        wrong = abs(sample.position[0]) < 0.012 and abs(sample.position[1] - 0.005) < 0.001
        return sample._replace(force=sample.force * 3.0) if wrong else sample

    result = examine([spoiled(sample) for sample in lines(level)])
    x, y = result.grid.nodes[:, :2].T
    there = (np.abs(x) < 0.008) & (np.abs(y - 0.005) < 0.004)
    assert (result.unassessed[there] == StiffnessMap.CONTRADICTED).all()
    assert result.findings == []
    assert (result.unassessed == StiffnessMap.CONTRADICTED).mean() < 0.1


def test_a_place_where_the_force_limit_was_met_far_above_the_depth_is_not_assessed() -> None:
    limited = {"force": 15.0, "depth": 0.004, "force_limited": True}
    result = examine([s._replace(**limited) if s.position[0] > 0.05 else s for s in lines(level)])  # type: ignore[arg-type]
    x, y = result.grid.nodes[:, :2].T
    assert (result.unassessed[(x > 0.057) & (x < 0.07) & (np.abs(y) < 0.06)] == StiffnessMap.YIELDED).all()
    assert result.findings == []


def test_a_lump_whose_middle_yields_to_the_force_limit_is_one_finding() -> None:
    limit, exponent = 8.0, load_calibration().exponent

    def yielding(sample: ForceSample) -> ForceSample:
        depth = sample.depth * min(1.0, (limit / sample.force) ** (1 / exponent))
        return sample._replace(force=min(sample.force, limit), depth=depth, force_limited=sample.force > limit)

    samples = lines(lambda xy: LEVEL + lump(xy, (0.0, 0.0), 0.025, 4.0))
    (area,), (unlimited,) = (examine(felt).findings for felt in ([yielding(s) for s in samples], samples))
    assert np.hypot(*area.centroid[:2]) < 0.002
    assert area.area == pytest.approx(unlimited.area, rel=0.1)
    assert area.ratio == pytest.approx(unlimited.ratio, rel=0.05)


def test_the_map_says_what_was_not_reached() -> None:
    result = examine([s for s in lines(level) if s.position[0] < 0])
    x, y = result.grid.nodes[:, :2].T
    assert (result.unassessed[x > 0.012] == StiffnessMap.NOT_REACHED).all()
    assert (result.unassessed[(np.abs(y) < 0.05) & (x < -0.005) & (x > -0.05)] == StiffnessMap.ASSESSED).all()
    assert np.median(np.log(result.upper / result.lower)[x > 0.05]) > 1.3 * np.median(width(result))


def test_too_few_samples_are_no_map() -> None:
    few = lines(level)[:5]
    assert assess(few, flat_grid(), REACH, FALSE_FINDINGS) is None
    assert assess_growing(few, flat_grid(), REACH) is None


def test_a_growing_map_says_what_the_final_one_does() -> None:
    samples = lines(lambda xy: LEVEL + lump(xy, (0.0, 0.0), 0.025, 3.0))
    grown = assess_growing(samples[::2], flat_grid(0.008), REACH)
    assert grown is not None
    inside = np.linalg.norm(grown.grid.nodes[:, :2], axis=1) < 0.01
    assert np.median(grown.apparent[inside]) == pytest.approx(3.0 * np.exp(LEVEL), rel=0.1)
    assert grown.findings == []


MIDDLE = (0.01, 0.0)
MUSCLE = Bump(*MIDDLE, 0.05, 0.025)
WALL = natural(3, 0.08)


def seen(samples: list[ForceSample]) -> Signs:
    o, shape = observations(samples), Bump(*MIDDLE, 0.03)
    return signs(Regression(o, (shape,), fit_log_amplitudes(o, (shape,))), shape)


def letting_go(samples: list[ForceSample]) -> list[ForceSample]:
    """Samples over a muscle that is twice as stiff at the touch and lets go within three seconds."""
    tension = MUSCLE(np.array([s.position[:2] for s in samples])) * np.exp(-np.array([s.time_in_contact for s in samples]) / 3.0)
    return [s._replace(force=s.force * 2.0**a) for s, a in zip(samples, tension, strict=True)]


def test_the_wall_rises_about_a_muscle_and_not_about_a_lump() -> None:
    muscle = seen(lines(lambda xy: LEVEL + WALL(xy) + np.log(2.6) * MUSCLE(xy)))
    single = seen(lines(lambda xy: LEVEL + WALL(xy) + lump(xy, MIDDLE, 0.025, 2.6)))
    assert muscle.rise > 0.45
    assert single.rise < 0.3


def test_a_muscle_that_lets_go_is_seen_to_fade() -> None:
    relaxed = lines(lambda xy: LEVEL + WALL(xy))
    assert seen(letting_go(relaxed)).fade > 0.3
    assert abs(seen(relaxed).fade) < 0.1


def test_lump_muscle_and_neither_compete() -> None:
    bump = Bump(0.0, 0.0, 0.02)
    stiff, soft = (Candidate(bump, e, 6.0, Signs(0.8, 0.2), bump, inside_m=0.05) for e in (0.5, -0.5))
    alone = stiff._replace(signs=Signs(0.0, -0.1))
    features, muscles = (np.array(rows) for rows in zip(*((c.features, c.signs) for c in (stiff, soft, alone)), strict=True))
    evidence = np.array([c.structures() for c in (stiff, soft, alone)])
    logits, kinds = causes(load_calibration(), features, muscles, evidence)
    guarding = kinds[:, FindingKind.MUSCLE]
    assert guarding[0] > 0.1 > guarding[2]
    assert guarding[1] == kinds[1, FindingKind.BONE] == kinds[0, FindingKind.SOFT_DEFECT] == 0
    rare, kinds_if_rare = causes(load_calibration(), features, muscles, evidence, shift=-3.0)
    assert rare == pytest.approx(logits)
    assert (kinds_if_rare[:, FindingKind.LUMP] < kinds[:, FindingKind.LUMP]).all()


@pytest.mark.parametrize(("conversion", "presses"), [(-0.2, True), (0.2, True), (0.15, False)])
def test_held_presses_determine_the_conversion_of_slides_or_the_band_is_wide(conversion: float, presses: bool) -> None:
    samples = lines(lambda xy: LEVEL + WALL(xy), conversion=conversion)
    result = examine([s for s in samples if presses or np.any(s.velocity)])
    assert held(result, np.exp(LEVEL + WALL(result.grid.nodes[:, :2]))) > (0.85 if presses else 0.95)
    if presses:
        assert result.background == pytest.approx(np.exp(LEVEL), rel=0.1)


def ridge_field(xy: np.ndarray) -> np.ndarray:
    along, across = np.abs(xy @ (0.8, 0.6)), np.abs(xy @ (-0.6, 0.8))
    return LEVEL + np.log(2.2) / (1 + np.exp((across - 0.005) / 0.003)) / (1 + np.exp((along - 0.04) / 0.003))


def test_a_ridge_is_named_and_marked_skin_is_believed() -> None:
    samples, scar = lines(ridge_field), Marked(path_m=((-0.032, -0.024), (0.032, 0.024)), width_m=0.02)
    results = (examine(samples, marked=marked) for marked in ((), (scar,)))
    plain, marked = (max(r.findings + r.candidates, key=lambda area: area.strength) for r in results)
    assert plain.kinds.argmax() == FindingKind.RIDGE
    assert marked.kinds[FindingKind.RIDGE] > plain.kinds[FindingKind.RIDGE]


def test_no_ridge_is_as_broad_as_a_lump() -> None:
    band = regression(lines(lambda xy: LEVEL + lump(xy * (0.2, 1.0), (0.0, 0.0), 0.025, 2.5)))
    rival = find_rival(band, Bump(0.0, 0.0, 0.03))
    assert rival is not None
    assert rival.radius < 0.019


def test_a_short_scar_is_not_lost_in_a_wider_shape_and_a_long_one_counts_where_it_is() -> None:
    shape = Bump(0.0, 0.0, 0.020)
    short = Marked(path_m=((-0.004, 0.0), (0.004, 0.0)), width_m=0.010)
    long = Marked(path_m=((-0.1, 0.0), (0.1, 0.0)), width_m=0.010)
    aside = Marked(path_m=((-0.1, 0.03), (0.1, 0.03)), width_m=0.010)
    assert marked_share((short,), shape) == pytest.approx(1.0, abs=0.15)
    assert marked_share((long,), shape) == pytest.approx(0.32, abs=0.08)  # a band of 10 mm across a disc of 40 mm
    assert marked_share((aside,), shape) == marked_share((), shape) == 0.0


def test_bone_is_stiff_beyond_the_border_and_steeper() -> None:
    def bone(xy: np.ndarray) -> np.ndarray:
        return 1 / (1 + np.exp((0.05 - xy[:, 0]) / 0.008))

    result = examine(lines(lambda xy: LEVEL + 1.2 * bone(xy), exponent=lambda xy: 1.4 + 1.2 * bone(xy)))
    assert not result.findings
    assert max(result.candidates, key=lambda area: area.strength).kinds.argmax() == FindingKind.BONE


def observed(stroke_m: float = 0.0) -> Observations:
    wall = natural(0, 0.15)
    return observations(lines(lambda xy: LEVEL + wall(xy), stroke_m=stroke_m))


@pytest.mark.parametrize("stroke_m", [0.0005, 0.0015])
def test_errors_of_the_strokes_are_found_from_the_data(stroke_m: float) -> None:
    found = fit_log_amplitudes(observed(stroke_m), ())
    assert np.exp(found[len(LENGTHS.fields_m) + 2]) == pytest.approx(stroke_m, rel=0.6)


def test_the_field_is_followed_and_its_uncertainty_grows_beyond_the_samples() -> None:
    wall, o = natural(0, 0.15), observed()
    fitted = Regression(o, (), fit_log_amplitudes(o, ()))
    mean, sd = fitted.field(o.xy)
    assert mean == pytest.approx(LEVEL + wall(o.xy), abs=0.05)
    _, far = fitted.field(o.xy + np.array((0.3, 0.0)))
    assert far.min() > 1.5 * sd.max()


def test_the_matched_filter_reads_a_bump_without_bias() -> None:
    bump = Bump(0.0, 0.0, 0.02)
    (log_contrast,), (t,) = match_bumps(regression(lines(lambda xy: LEVEL + 0.4 * bump(xy), noise=0.002)), [bump])
    assert log_contrast == pytest.approx(0.4, abs=0.05)
    assert t > 3


@pytest.mark.parametrize("edge", [0.007, 0.013])
def test_the_edge_with_which_a_lump_is_felt_is_found(edge: float) -> None:
    lump = Bump(0.005, -0.01, 0.02, edge)
    found, t = find_disc(regression(lines(lambda xy: LEVEL + 0.8 * lump(xy), noise=0.01)))
    assert found is not None
    assert found.edge == pytest.approx(edge, rel=0.2)
    assert found.radius == pytest.approx(lump.radius, rel=0.15)
    assert t > 5


def test_what_one_stroke_alone_says_is_not_believed() -> None:
    """A hiccup of a second lifts the force along three centimetres of one stroke, a lump that of all strokes over it."""
    bump, smooth = Bump(0.0, 0.005, 0.015), lines(level, noise=0.005)
    hiccup = [s._replace(force=1.3 * s.force) if s.stroke == 6 and abs(s.position[0]) < 0.015 else s for s in smooth]
    lumpy = lines(lambda xy: LEVEL + lump(xy, (0.0, 0.005), 0.015, 1.3), noise=0.005)
    shares = []
    for samples in (hiccup, lumpy):
        prior = regression(samples)
        (t,) = match_bumps(prior, [bump])[1]
        shares.append(limit_strength(prior, bump, float(t)) / t)
    assert shares[0] < 0.5
    assert shares[1] == pytest.approx(1.0, rel=0.15)


def test_a_lump_in_the_model_takes_its_contrast() -> None:
    bump, samples = Bump(0.0, 0.0, 0.02), lines(lambda xy: LEVEL + lump(xy, (0.0, 0.0), 0.02, 2.0))
    mean, covariance = regression(samples, bump).contrast(bump, np.zeros((1, 2)))
    assert np.exp(mean[0]) == pytest.approx(2.0, rel=0.15)
    assert covariance[0, 0] > 0


def test_strokes_determine_the_zero_of_the_force_and_the_level_becomes_uncertain() -> None:
    zeros, wall = 0.25 * np.random.default_rng(0).standard_normal(20), natural(1, 0.1)
    steady = lines(lambda xy: LEVEL + wall(xy))
    found = []
    for samples in (steady, [s._replace(force=s.force + float(zeros[s.stroke])) for s in steady]):
        o = observations(samples)
        fitted = Regression(o, (), fit_log_amplitudes(o, ()))
        found.append((np.exp(fitted.log_amplitudes[-2]), fitted.field(np.zeros((1, 2)))[1][0]))
    (small, sure), (large, unsure) = found
    assert large > 1.3 * small
    assert unsure > 1.2 * sure


RADIUS, DEPTH, FORCE = 0.006, 0.002, 1.0
VESSEL = ridge(np.array(((-0.015, 0.0), (0.0, 0.002), (0.014, 0.008))), 0.0025, 0.0025)
BALL = Bump(0.005, -0.004, 0.004, 0.0025)


def presses(shape: Bump | None, seed: int = 0, noise: float = 0.04, contrast: float = 1.5) -> list[ForceSample]:
    rng = np.random.default_rng(seed)
    axis = np.arange(-0.02, 0.0201, 0.0025)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    log_force = np.log(FORCE) + 0.05 * np.sin(xy[:, 0] / 0.01) + noise * rng.standard_normal(len(xy))
    if shape is not None:
        log_force += np.log(contrast) * shape(xy)
    return [
        ForceSample(10.0 * k, np.array((*p, 0.0)), UP, np.zeros(3), DEPTH, float(np.exp(f)), 0.02, 1.0, False, k)
        for k, (p, f) in enumerate(zip(xy, log_force, strict=True))
    ]


def examined(samples: list[ForceSample]) -> AssessedMap:
    standard = PressStandard.of(samples, RADIUS, 1.2)
    surface = np.array([sample.position for sample in samples])
    grid = map_grid(surface, (0.0, 0.0), (0.04, 0.04), standard.lengths.pitch_m, standard.lengths.node_m)
    result = assess(samples, grid, 0.002, 0.02, standard)
    assert result is not None
    return result


@pytest.mark.parametrize(("shape", "long"), [(VESSEL, True), (BALL, False)])
def test_a_curved_vessel_and_a_ball_are_found_as_they_are(shape: Bump, long: bool) -> None:
    result = examined(presses(shape))
    (found,) = result.findings
    truth = shape(result.grid.nodes[:, :2]) > 0.5
    assert 2 * (truth & found.nodes).sum() / (truth.sum() + found.nodes.sum()) > 0.6
    assert (found.length > 0.02) == long
    assert result.background == pytest.approx(FORCE, rel=0.05)


def test_a_plain_body_has_no_finding_and_its_band_holds_what_a_press_feels() -> None:
    result = examined(presses(None))
    assert result.findings == []
    again = np.array([sample.force for sample in presses(None, seed=1)])
    at = [int(np.argmin(np.hypot(*(result.grid.nodes[:, :2] - s.position[:2]).T))) for s in presses(None)]
    assert 0.8 < ((result.lower[at] <= again) & (again <= result.upper[at])).mean() <= 0.98


def test_a_ridge_whose_ends_coincide_is_a_disc() -> None:
    xy = np.array(((0.0, 0.0), (0.01, 0.0), (0.03, 0.02)))
    band = ridge(np.zeros((2, 2)), 0.005, 0.007)
    np.testing.assert_allclose(band(xy), Bump(0.0, 0.0, 0.005, 0.007)(xy))
