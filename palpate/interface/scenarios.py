"""Scenarios for the library: by name or file, with settings as keywords."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from palpate.run.inputs import check_examinable
from palpate.run.options import DEFAULT_SCENARIO
from palpate_models.scenario.load import ScenarioError, as_settings, load_scenario, whole_scenario
from palpate_models.scenario.schema import Scenario


def scenario(source: str | Path | Scenario = DEFAULT_SCENARIO, /, *, seed: int | None = None, **settings: Any) -> Scenario:
    """Return a scenario after the checks of the command line.

    Parameters
    ----------
    source
        Name of a scenario (`palpate scenarios` lists them), path of a YAML file, or a scenario; a scenario takes no settings.
    seed
        Seed of patient and equipment; by default the scenario's.
    **settings
        Fields of a scenario, each section a mapping: `exam={"pattern": "raster", "depth_m": 0.008}`. Other fields keep their
        values. A field may also be given by its path: `**{"exam.depth_m": 0.008}`.

    Returns
    -------
    Scenario
        Frozen; a person that the scenario leaves to the seed has been drawn.

    Raises
    ------
    ScenarioError
        Names file, field, value and what is allowed.
    MeshError
        The phantom cannot be built.
    PluginError
        There is no such service.

    Examples
    --------
    >>> import palpate
    >>> chosen = palpate.scenario("lump", seed=3, exam={"pattern": "raster", "region_m": [0.1, 0.1]})
    >>> chosen.exam.pattern, chosen.exam.region_m, chosen.seed
    ('raster', (0.1, 0.1), 3)
    >>> palpate.scenario("lump", exam={"dept_m": 0.008})  # doctest: +IGNORE_EXCEPTION_DETAIL
    Traceback (most recent call last):
        ...
    ScenarioError: --set exam.dept_m: exam.dept_m = 0.008: unknown field. Did you mean depth_m?
    """
    given = as_settings(dict(paths(settings)))
    if isinstance(source, Scenario):
        if given:
            raise ScenarioError(f"{source.name}: {given[0]}: settings need the name or file of a scenario, not a Scenario object")
        return check_examinable(whole_scenario(source, seed))
    return check_examinable(load_scenario(str(source), given, seed))


def paths(settings: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Yield path and value of each field of nested mappings."""
    for name, value in settings.items():
        path = f"{above}{name}"
        if isinstance(value, Mapping) and value:
            yield from paths(value, f"{path}.")
        else:
            yield path, value
