"""Any FMU run as it is, its scalar outputs plotted over time."""

from pathlib import Path

import numpy as np

from palpate_fmu.reading import FmuError, read_description


def run_and_plot(file: Path, out: Path) -> tuple[str, ...]:
    """Simulate an FMU over its default experiment with its start values; write a PNG, and a CSV of the same name.

    Returns the names of the outputs. Raises FmuError if it fails or has no scalar output.
    """
    import fmpy  # noqa: PLC0415  (slow to import)
    from matplotlib.figure import Figure  # noqa: PLC0415

    try:
        description, _ = read_description(file)
        names = tuple(v.name for v in description.modelVariables if v.causality == "output" and not v.dimensions)
        if not names:
            raise FmuError(f"{file}: no scalar output to plot")
        result = fmpy.simulate_fmu(str(file), output=list(names), validate=False)
    except FmuError:
        raise
    except Exception as error:
        raise FmuError(f"{file}: {error}") from error
    for name in names:
        if not np.isfinite(result[name]).all():
            k = int(np.flatnonzero(~np.isfinite(result[name]))[0])
            raise FmuError(f"{file}: {name} is {result[name][k]} at {result['time'][k]:g} s: want finite numbers")
    figure = Figure(figsize=(8, 1 + 1.6 * min(len(names), 12)), layout="constrained")
    axes = np.atleast_1d(figure.subplots(min(len(names), 12), 1, sharex=True))
    for axis, name in zip(axes, names, strict=False):
        axis.plot(result["time"], result[name], color="#1f5fa8")
        axis.set_ylabel(name, fontsize=8, parse_math=False)
        axis.spines[["top", "right"]].set_visible(False)
    axes[-1].set_xlabel("time [s]")
    figure.suptitle(description.modelName, parse_math=False)
    figure.savefig(out, dpi=130)
    columns = np.column_stack([result[name] for name in ("time", *names)])
    np.savetxt(out.with_suffix(".csv"), columns, fmt="%.17g", delimiter=",", header=",".join(("time", *names)), comments="")
    return names
