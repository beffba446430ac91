"""Simulation of an FMU: an abdomen is pressed, held and released along the normal; any other is run as it is and plotted."""

from pathlib import Path

import numpy as np

from palpate_errors import restate
from palpate_fmu.instance import FmuInstance
from palpate_fmu.reading import FmuError, read_description
from palpate_fmu.variables import STEP_S
from palpate_models.numerics.frames import Array


def run_and_plot(file: Path, out: Path) -> tuple[str, ...]:
    """Simulate an FMU over its default experiment with its start values; write a PNG, and a CSV of the same name.

    Returns the names of the outputs. Raises FmuError if it fails or has no scalar output.
    """
    import fmpy  # noqa: PLC0415  (slow to import)
    from matplotlib.figure import Figure  # noqa: PLC0415

    with restate(Exception, FmuError, file, but=FmuError):
        description, _ = read_description(file)
        names = tuple(v.name for v in description.modelVariables if v.causality == "output" and not v.dimensions)
        if not names:
            raise FmuError(f"{file}: no scalar output to plot")
        result = fmpy.simulate_fmu(str(file), output=list(names), validate=False)
    for name in names:
        if not np.isfinite(result[name]).all():
            k = int(np.flatnonzero(~np.isfinite(result[name]))[0])
            raise FmuError(f"{file}: {name} is {result[name][k]} at {result['time'][k]:g} s: expected finite numbers")
    figure = Figure(figsize=(8, 1 + 1.6 * min(len(names), 12)), layout="constrained")
    axes = np.atleast_1d(figure.subplots(min(len(names), 12), 1, sharex=True))
    for axis, name in zip(axes, names, strict=False):
        axis.plot(result["time"], result[name], color="#1f5fa8")
        axis.set_ylabel(name, fontsize=8, parse_math=False)
        axis.spines[["top", "right"]].set_visible(False)
    axes[-1].set_xlabel("time [s]")
    figure.suptitle(description.modelName, parse_math=False)
    figure.savefig(out, dpi=130)
    _write_csv(out, ",".join(("time", *names)), np.column_stack([result[name] for name in ("time", *names)]))
    return names


def _write_csv(out: Path, header: str, rows: Array) -> None:
    np.savetxt(out.with_suffix(".csv"), rows, fmt="%.17g", delimiter=",", header=header, comments="")


GAP_M = 0.002
"""Distance from the surface at which the motion starts and ends."""
COLUMNS = "time [s],indentation_depth [m],normal_force [N],contacts,elastic_energy [J]"


def probe(
    fmu: FmuInstance,
    at_m: tuple[float, float] = (0.0, 0.05),
    depth_m: float = 0.010,
    speed_mps: float = 0.02,
    hold_s: float = 1.0,
) -> Array:
    """Press at a point (x, y) of the abdomen frame [m] to a depth, hold it and withdraw; return `COLUMNS`, shape (n, 5).

    The FMU must be fresh. Its sphere moves along the normal of the rest surface beneath (x, y, 0.05 m).
    """
    motion = fmu.port(["indenter_position", "indenter_velocity"])
    position, velocity = motion["indenter_position"], motion["indenter_velocity"]
    place = fmu.port(["surface_point", "surface_normal"])
    result = fmu.port(["indentation_depth", "normal_force", "elastic_energy"])
    counter = fmu.port(["contacts"])
    radius = float(fmu.get("indenter_radius"))
    position[:] = (*at_m, 0.05)
    motion.push()
    place.pull()
    point, normal = place["surface_point"].copy(), place["surface_normal"].copy()
    way = (depth_m + GAP_M) / speed_mps
    steps = round((2 * way + hold_s) / STEP_S)
    rows = np.empty((steps, 5))
    for k in range(steps):
        t = (k + 1) * STEP_S
        if t < way:
            depth, rate = speed_mps * t - GAP_M, speed_mps
        elif t < way + hold_s:
            depth, rate = depth_m, 0.0
        else:
            depth, rate = depth_m - speed_mps * (t - way - hold_s), -speed_mps
        position[:] = point + (radius - depth) * normal
        velocity[:] = -rate * normal
        motion.push()
        fmu.step(k * STEP_S, STEP_S)
        rows[k] = (t, *result.pull()[:2], int(counter.pull()[0]), result.values[2])
    return rows


def plot_probing(rows: Array, out: Path, title: str) -> None:
    """Write force against depth, and both over time, as a PNG, and all columns of `probe` as a CSV of the same name."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (slow to import)

    figure = Figure(figsize=(9, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    time, depth, force = rows.T[:3]
    left.plot(1e3 * depth, force, color="#1f5fa8")
    left.set(xlabel="indentation depth [mm]", ylabel="normal force [N]", title="force against depth")
    right.plot(time, force, color="#1f5fa8", label="normal force [N]")
    right.plot(time, 1e3 * depth, color="#888888", linewidth=1, label="depth [mm]")
    right.set(xlabel="time [s]", title="press, hold, withdraw")
    right.legend(frameon=False)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
        axes.axhline(0, color="#cccccc", linewidth=0.8, zorder=0)
    figure.suptitle(title)
    figure.savefig(out, dpi=130)
    _write_csv(out, COLUMNS, rows)
