"""study.html: a study's figures and plots on one self-contained page. Plots are SVG with the page's colour variables."""

import io
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Final, Literal

import numpy as np
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator, PercentFormatter

from palpate.report.figures import INK, QUIET
from palpate.report.page_figures import GRID, plain
from palpate.study.statistics.accuracy import Agreement, FindingCalibration
from palpate.study.statistics.comparison import QUANTITIES, MethodRow
from palpate.study.statistics.detectability import FELT, LOGARITHMIC, MADE, Surface
from palpate.study.statistics.detection import GRID as ROC_GRID, RATES
from palpate.study.statistics.estimate import Estimate

COLOURS: Final = ("#0f766e", "#c2410c", "#7c3aed", "#2563eb", "#be185d", "#854d0e")
HUMAN: Final = "#b91c1c"
MAX_METHODS: Final = len(COLOURS)
"""Methods in one plot."""
VARIABLES: Final = {INK: "--ink", QUIET: "--quiet", GRID: "--line", HUMAN: "--bad"} | {
    colour: f"--c{i}" for i, colour in enumerate(COLOURS)
}
"""The page's names of the colours."""
COVARIATES: Final = {
    "felt_contrast": ("felt contrast, force with the lump over force without", 1.0),
    "felt_radius_m": ("felt radius [mm]", 1e3),
    "depth_m": ("depth of the lump [mm]", 1e3),
    "contrast": ("stiffness of the lump over its surroundings", 1.0),
    "radius_m": ("radius of the lump [mm]", 1e3),
}


HUMANS: Final[dict[str, Any]] = {
    "found": 0.44,
    "by_size": ((0.003, 0.14), (0.010, 0.87)),
    "source": "Fletcher et al., Physicians' abilities to detect lumps in silicone breast models, JAMA 1985;253:2224-2228,"
    " doi:10.1001/jama.1985.03350390066027",
    "caveat": "80 physicians searched silicone breast models by hand: another organ, smaller lumps, no breathing."
    " The line shows what trained hands achieved there; it is not a comparison on equal patients.",
}
"""Detection of lumps by hand, for plots of detection: mean share of lumps found by the 80 physicians (range 0.17 to 0.83), and
share found by size [m], taken as their diameter, by which lumps of models are sold."""
MANY: Final = 400
"""Points from which a cloud is drawn as an image."""


def _figure(width: float, height: float, columns: int = 1) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(width, height), facecolor="none")
    figure.set_layout_engine("constrained", w_pad=0.08, h_pad=0.08)
    axes = list(np.atleast_1d(figure.subplots(1, columns)))
    for each in axes:
        each.set_facecolor("none")
        for spine in each.spines.values():
            spine.set_color(QUIET)
    return figure, axes


def _svg(figure: Figure) -> Markup:
    """Return the figure as an element of the page: text, escaped by matplotlib, stays text; colours are the page's variables."""
    stream = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "palpate"}):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None, "Type": None, "Format": None}, dpi=150)
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    for colour, variable in VARIABLES.items():
        text = text.replace(colour, f"var({variable})")
    return Markup(text)


def _legend(axes: Axes, place: Literal["best", "upper left", "lower right"] = "best", below: bool = False) -> None:
    axes.legend(fontsize=8.5, frameon=False, labelcolor=INK, loc=place, bbox_to_anchor=(0, -0.17) if below else None)


def _human(axes: Axes) -> None:
    """Draw the detection rate of human examiners."""
    label = f"80 physicians, breast models: {HUMANS['found']:.0%} (Fletcher 1985)"
    axes.axhline(HUMANS["found"], color=HUMAN, ls="--", lw=1.2, label=label)


def _title(axes: Axes, words: str) -> None:
    axes.set_title(words, fontsize=10, color=INK, loc="left")


def _errorbar(axes: Axes, x: Sequence[float], rows: Sequence[Estimate], color: str, label: str) -> None:
    """Draw estimates with their intervals."""
    known = [(at, e.value, e.low, e.high) for at, e in zip(x, rows, strict=True) if e.value is not None]
    if known:
        at, value, low, high = np.array([[np.nan if v is None else v for v in row] for row in known], dtype=float).T
        bars = np.clip([value - low, high - value], 0, None)
        axes.errorbar(at, value, yerr=bars, fmt="o", ms=4, lw=1.1, capsize=2, color=color, label=label)


def roc(methods: Sequence[MethodRow]) -> Markup | None:
    """Return the ROC per patient of the first MAX_METHODS methods; None if none has a curve."""
    shown = [(a.name, a.roc) for a in methods[:MAX_METHODS] if a.roc is not None]
    if not shown:
        return None
    figure, (axes,) = _figure(6.2, 5.2)
    for color, (name, curve) in zip(COLOURS, shown, strict=False):
        axes.plot(curve.false_rate, curve.true_rate, color=color, lw=1.8, label=f"{name}: AUC {curve.auc.value:.3f}")
        axes.fill_between(ROC_GRID, curve.low, curve.high, color=color, alpha=0.13, lw=0)
    axes.plot([0, 1], [0, 1], color=QUIET, lw=0.8, ls=":")
    _human(axes)
    plain(axes, "patients with a lump above the threshold", "persons without a lump above it")
    _percent(axes, both=True)
    axes.set_xlim(-0.01, 1)
    axes.set_ylim(0, 1.02)
    _legend(axes, "lower right")
    return _svg(figure)


def froc(methods: Sequence[MethodRow]) -> Markup | None:
    """Return the FROC of the first MAX_METHODS methods; None if none has a curve."""
    shown = [(a.name, a.froc_curve) for a in methods[:MAX_METHODS] if a.froc_curve is not None]
    if not shown:
        return None
    figure, (axes,) = _figure(7.4, 5.2)
    lowest = RATES[0] / 2
    for color, (name, curve) in zip(COLOURS, shown, strict=False):
        x = np.maximum(curve.false_findings, lowest)
        axes.plot(x, curve.sensitivity, color=color, lw=1.8, label=f"{name}: mean {curve.mean.value:.3f}")
        axes.fill_between(x, curve.low, curve.high, color=color, alpha=0.13, lw=0)
        axes.plot(RATES, [e.value or 0.0 for e in curve.at.values()], "o", ms=4, color=color)
    _human(axes)
    plain(axes, "lumps found", "false findings an examination")
    axes.set_xscale("log", base=2)
    axes.set_xticks(RATES, ["1/8", "1/4", "1/2", "1", "2", "4", "8"])
    axes.xaxis.set_minor_locator(NullLocator())
    _percent(axes)
    axes.set_xlim(lowest, RATES[-1])
    axes.set_ylim(0, 1.02)
    _legend(axes, "lower right")
    return _svg(figure)


def detectability(method: MethodRow, names: Sequence[str]) -> Markup | None:
    """Return the probability of detection against each covariate: binned rates, and the surface at quartiles of another one.

    None where no lump is known.
    """
    if not any(method.observed[name] for name in names):
        return None
    surface = method.felt if tuple(names) == FELT else method.made
    figure, columns = _figure(14.5, 5.6, len(names))
    for axes, name in zip(columns, names, strict=True):
        words, scale = COVARIATES[name]
        if surface is not None and name in surface.covariates:
            _sections(axes, surface, name)
        x, rows = zip(*method.observed[name], strict=True) if method.observed[name] else ((), ())
        _errorbar(axes, [scale * at for at in x], rows, INK, "found, in bins of equal number")
        _human(axes)
        if name == "radius_m":
            sizes, shares = zip(*HUMANS["by_size"], strict=True)
            radii = [scale * size / 2 for size in sizes]
            axes.plot(radii, shares, "D", color=HUMAN, ms=6, label="physicians, by size of lump")
        plain(axes, "probability of detection" if name == names[0] else "", words)
        if name in LOGARITHMIC:
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.xaxis.set_minor_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.tick_params(which="minor", labelsize=7.5, colors=QUIET)
        _percent(axes)
        axes.set_ylim(-0.02, 1.02)
        _legend(axes, "upper left", below=True)
    return _svg(figure)


def _sections(axes: Axes, surface: Surface, name: str) -> None:
    """Draw the surface along one covariate, at the quartiles of another one, with the rest at their medians."""
    second = next((other for other in surface.covariates if other != name), None)
    _, scale = COVARIATES[name]
    x = np.geomspace(*surface.range[name], 60) if name in LOGARITHMIC else np.linspace(*surface.range[name], 60)
    for i, level in enumerate(surface.quartiles[second] if second else (0.0,)):
        at = {name: x} | ({second: np.full(len(x), level)} if second else {})
        value, low, high = surface.probability(at)
        words, unit = COVARIATES[second] if second else ("fitted", 1.0)
        label = f"{words.split(',')[0].split(' [')[0]} {unit * level:.3g}{' mm' if unit > 1 else ''}" if second else "fitted"
        axes.plot(scale * x, value, color=COLOURS[i], lw=1.5, label=label)
        axes.fill_between(scale * x, low, high, color=COLOURS[i], alpha=0.12, lw=0)


def errors(method: MethodRow) -> Markup | None:
    """Return place errors and the agreement of size and stiffness; None without a matched finding."""
    e = method.errors
    if not len(e.place_m):
        return None
    figure, (place, size, ratio) = _figure(14.5, 4.4, 3)
    x = np.sort(e.place_m) * 1e3
    place.step(np.append(0, x), np.linspace(0, 1, len(x) + 1), where="post", color=COLOURS[0], lw=1.8)
    plain(place, "part of the matched findings", "error of place [mm]")
    _percent(place)
    _title(place, f"Place, n = {len(x)}")
    _bland_altman(size, e.radius_m, 1e3)
    plain(size, "estimated less true radius [mm]", "mean of both [mm]")
    _title(size, f"Size, n = {e.radius_m.bias.n}")
    _bland_altman(ratio, e.log_ratio, 1.0)
    plain(ratio, "estimated over true ratio", "geometric mean of both")
    for axis in (ratio.xaxis, ratio.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{np.exp(value):.2f}"))
    _title(ratio, f"Stiffness ratio, n = {e.log_ratio.bias.n}")
    return _svg(figure)


def _bland_altman(axes: Axes, agreement: Agreement, scale: float) -> None:
    many = len(agreement.mean) > MANY
    axes.plot(scale * agreement.mean, scale * agreement.difference, ".", ms=4, color=COLOURS[0], alpha=0.6, rasterized=many)
    for line, style in ((agreement.bias, "-"), (agreement.lower, "--"), (agreement.upper, "--")):
        if line.value is not None:
            axes.axhline(scale * line.value, color=INK, lw=1.1, ls=style)
        if line.low is not None and line.high is not None:
            axes.axhspan(scale * line.low, scale * line.high, color=QUIET, alpha=0.18, lw=0)
    axes.axhline(0, color=QUIET, lw=0.7, ls=":")


def reliability(rows: Sequence[tuple[str, FindingCalibration]]) -> Markup | None:
    """Return the reliability diagram of the first MAX_METHODS methods; None without any."""
    if not rows:
        return None
    figure, (axes,) = _figure(6.2, 5.2)
    for color, (name, calibrated) in zip(COLOURS, rows, strict=False):
        x, parts = zip(*calibrated.bins, strict=True)
        slope = calibrated.slope.value
        label = name if slope is None else f"{name}: slope {slope:.2f}"
        _errorbar(axes, x, parts, color, label)
        axes.plot(x, [part.value for part in parts], color=color, lw=1)
    axes.plot([0, 1], [0, 1], color=QUIET, lw=0.8, ls=":")
    plain(axes, "part that hits a lump", "confidence")
    _percent(axes, both=True)
    axes.set_xlim(0, 1.02)
    axes.set_ylim(-0.02, 1.02)
    _legend(axes, "upper left")
    return _svg(figure)


def _percent(axes: Axes, both: bool = False) -> None:
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    if both:
        axes.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))


def render(summary: Mapping[str, Any], methods: Sequence[MethodRow]) -> str:
    """Return the page as HTML. `summary` has the content of study.json."""
    loader = ChoiceLoader([PackageLoader("palpate.study"), PackageLoader("palpate.report")])
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"figure": figure, "p": p_value, "words": lambda name: COVARIATES[name][0]}
    environment.filters["percent"] = partial(figure, scale=100.0, digits=1, unit=" %")
    environment.filters["mm"] = partial(figure, scale=1e3, digits=1, unit=" mm")
    shown = methods[:MAX_METHODS]
    calibrated = [(a.name, a.calibration) for a in shown if a.calibration is not None]
    return environment.get_template("study.html.j2").render(
        s=summary,
        shown=[a.name for a in shown],
        methods=[summary["methods"][a.name] for a in shown],
        human=HUMANS,
        quantities=QUANTITIES,
        roc=roc(methods),
        froc=froc(methods),
        felt={a.name: detectability(a, FELT) for a in shown},
        made={a.name: detectability(a, MADE) for a in shown},
        errors={a.name: errors(a) for a in shown},
        reliability=reliability(calibrated),
    )


def figure(estimate: Mapping[str, Any] | None, scale: float = 1.0, digits: int = 2, unit: str = "") -> Markup:
    """Return a figure with its interval and sample size."""
    if estimate is None or estimate["value"] is None:
        how = "" if estimate is None or estimate["interval"].startswith(("bootstrap", "Wilson")) else f": {estimate['interval']}"
        n = "" if estimate is None else f" (n = {estimate['n']})"
        return Markup("<span class=quiet>not known{}{}</span>").format(n, how)
    value, low, high = (None if estimate[k] is None else f"{scale * estimate[k]:.{digits}f}" for k in ("value", "low", "high"))
    ends = "no interval" if low is None else f"{low} to {high}"
    template = Markup("<b>{}{}</b> <span class=quiet title='{}'>({}; n = {})</span>")
    return template.format(value, unit, f"{estimate['n']} {estimate['of']}; {estimate['interval']}", ends, estimate["n"])


def p_value(value: float | None) -> str:
    """Return a p value as text."""
    return "" if value is None else "p < 0.001" if value < 0.001 else f"p = {value:.3f}"
