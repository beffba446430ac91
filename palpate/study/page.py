"""study.html: a study's figures and plots on one self-contained page, in the style of report.html."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from palpate.study import human_line, plots
from palpate.study.statistics.analysis import Analysis
from palpate.study.statistics.comparison import QUANTITIES, Comparison
from palpate.study.statistics.detectability import FELT, MADE

TORNADOES = ("lumps_found", "false_findings", "score", "place_error_m")
FEWEST_FOR_TORNADO = 2
"""Number of compared methods from which differences are drawn as a tornado plot."""


def render(summary: Mapping[str, Any], analyses: Sequence[Analysis], comparisons: Sequence[Comparison]) -> str:
    """Return the page as HTML. `summary` has the content of study.json."""
    loader = ChoiceLoader([PackageLoader("palpate.study"), PackageLoader("palpate.report")])
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"figure": figure, "percent": percent, "mm": millimetres, "p": p_value, "words": covariate_words}
    shown = analyses[: plots.MOST]
    calibrated = [(a.name, a.calibration) for a in shown if a.calibration is not None]
    many = len(comparisons) >= FEWEST_FOR_TORNADO
    return environment.get_template("study.html.j2").render(
        s=summary,
        shown=[a.name for a in shown],
        methods=[summary["methods"][a.name] for a in shown],
        human=human_line,
        quantities=QUANTITIES,
        roc=_safe(plots.roc(analyses)),
        froc=_safe(plots.froc(analyses)),
        felt={a.name: _safe(plots.detectability(a, FELT)) for a in shown},
        made={a.name: _safe(plots.detectability(a, MADE)) for a in shown},
        errors={a.name: _safe(plots.errors(a)) for a in shown},
        reliability=_safe(plots.reliability(calibrated)),
        effort=_safe(plots.effort(analyses)),
        tornadoes=[plot for name in TORNADOES if many and (plot := _safe(plots.tornado(comparisons, name)))],
    )


def _safe(svg: str | None) -> Markup | None:
    """Return an SVG of `plots`, in which matplotlib has escaped names."""
    return None if svg is None else Markup(svg)


def figure(estimate: Mapping[str, Any] | None, scale: float = 1.0, digits: int = 2, unit: str = "") -> Markup:
    """Return a figure with its interval and sample size."""
    if estimate is None or estimate["value"] is None:
        why = "" if estimate is None or estimate["interval"].startswith(("bootstrap", "Wilson")) else f": {estimate['interval']}"
        n = "" if estimate is None else f" (n = {estimate['n']})"
        return Markup("<span class=quiet>not known{}{}</span>").format(n, why)
    value, low, high = (None if estimate[k] is None else f"{scale * estimate[k]:.{digits}f}" for k in ("value", "low", "high"))
    ends = "no interval" if low is None else f"{low} to {high}"
    template = Markup("<b>{}{}</b> <span class=quiet title='{}'>({}; n = {})</span>")
    return template.format(value, unit, f"{estimate['n']} {estimate['of']}; {estimate['interval']}", ends, estimate["n"])


def percent(estimate: Mapping[str, Any] | None, digits: int = 1) -> Markup:
    """Return a rate in per cent."""
    return figure(estimate, 100.0, digits, " %")


def millimetres(estimate: Mapping[str, Any] | None, digits: int = 1) -> Markup:
    """Return a length in millimetres."""
    return figure(estimate, 1e3, digits, " mm")


def p_value(value: float | None) -> str:
    """Return a p value as text."""
    return "" if value is None else "p < 0.001" if value < 0.001 else f"p = {value:.3f}"


def covariate_words(name: str) -> str:
    """Return the label of a covariate."""
    return plots.COVARIATES[name][0]
