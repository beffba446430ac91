"""A small FMU that is not ours, FMI 2.0 or 3.0: a wall of springs with input z and output f that behaves oddly on request.

If its parameter tau is not 0 it is three first-order lags in millimetres, y after u, with a fixed step of 10 ms (FMI 3.0).
"""

import tempfile
import zipfile
from enum import IntEnum
from functools import cache
from pathlib import Path

from palpate_fmu.compiling import compile_library, native, platforms

Odd = IntEnum(
    "Odd", "TERMINATE EARLY EVENT EARLY_AT_END DISCARD ERROR FATAL PENDING UNKNOWN WARNING NAN INFINITE ONLY_FROM_START"
)
"""Fault of a step, from the time of the parameter `at` on; the last one can only be started at `at`."""
SOURCE = """
#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#define EXPORT __attribute__((visibility("default")))
typedef struct { double z, f, odd, at, reached, a[4], u[3], y[3], tau; unsigned long size; bool configuring; } Wall;

static int start(Wall *w, double t) { return (int)w->odd == 13 && t != w->at ? 3 : 0; }

static int step(Wall *w, double t, double dt, bool *event, bool *end, bool *early, double *last) {
    const int odd = t + dt > w->at + 1e-9 ? (int)w->odd : 0;
    static const int status[] = {0, 0, 0, 0, 0, 2, 3, 4, 5, 42, 1};
    w->f = odd == 11 ? NAN : odd == 12 ? INFINITY : fmax(0.0, 800.0 * (0.945 - w->z));
    for (int k = 0; k < 4; k++) w->a[k] = k + 1;
    *event = odd == 3;
    *end = odd == 1;
    *early = odd == 2 || odd == 4;
    w->reached = *last = odd == 2 || odd == 5 ? t + dt / 4 : t + dt;
    if (w->tau && fabs(dt - 0.01) > 1e-9) return 3;
    for (int k = 0; w->tau && k < 3; k++) w->y[k] += (1 - exp(-dt / w->tau)) * (w->u[k] - w->y[k]);
    return odd <= 10 ? status[odd] : 0;
}

#if FMI_VERSION == 2
EXPORT void *fmi2Instantiate(const char *n, int t, const char *g, const char *r, const void *f, int v, int l) {
    (void)n, (void)t, (void)g, (void)r, (void)f, (void)v, (void)l;
    return calloc(1, sizeof(Wall));
}
EXPORT void fmi2FreeInstance(void *c) { free(c); }
EXPORT int fmi2GetReal(void *c, const unsigned *vr, size_t n, double *v) {
    for (size_t k = 0; k < n; k++) v[k] = ((double *)c)[vr[k]];
    return 0;
}
EXPORT int fmi2SetReal(void *c, const unsigned *vr, size_t n, const double *v) {
    for (size_t k = 0; k < n; k++) ((double *)c)[vr[k]] = v[k];
    return 0;
}
EXPORT int fmi2GetBoolean(void *c, const unsigned *vr, size_t n, int *v) {
    (void)vr;
    for (size_t k = 0; k < n; k++) v[k] = ((Wall *)c)->f > 0;
    return 0;
}
EXPORT int fmi2GetRealStatus(void *c, int kind, double *v) { return kind == 2 ? (*v = ((Wall *)c)->reached, 0) : 3; }
EXPORT int fmi2DoStep(void *c, double t, double dt, int k) {
    bool flags[3];
    double last;
    (void)k;
    return step(c, t, dt, &flags[0], &flags[1], &flags[2], &last);
}
EXPORT int fmi2SetupExperiment(void *c, int a, double b, double t, int e, double f) {
    (void)a, (void)b, (void)e, (void)f;
    return start(c, t);
}
EXPORT int fmi2EnterInitializationMode(void *c) { return !c; }
EXPORT int fmi2ExitInitializationMode(void *c) { return !c; }
#else
EXPORT void *fmi3InstantiateCoSimulation(const char *n, const char *g, const char *r, bool v, bool l, bool e, bool w,
                                         const unsigned *i, size_t m, void *x, void *f, void *u) {
    (void)n, (void)r, (void)v, (void)l, (void)e, (void)w, (void)i, (void)m, (void)x, (void)f, (void)u;
    return strcmp(g, "wall") ? NULL : calloc(1, sizeof(Wall));
}
static size_t many(const Wall *w, unsigned vr) { return vr == 10 && w->size ? w->size : vr == 10 ? 4 : vr >= 20 ? 3 : 1; }
static double *place(Wall *w, unsigned vr) { return vr == 10 ? w->a : vr == 20 ? w->u : vr == 21 ? w->y : (double *)w + vr; }
EXPORT void fmi3FreeInstance(void *c) { free(c); }
EXPORT int fmi3GetFloat64(void *c, const unsigned *vr, size_t n, double *v, size_t room) {
    (void)room;
    for (size_t k = 0; k < n; v += many(c, vr[k++])) memcpy(v, place(c, vr[k]), many(c, vr[k]) * sizeof *v);
    return 0;
}
EXPORT int fmi3EnterConfigurationMode(void *c) { return ((Wall *)c)->configuring = true, 0; }
EXPORT int fmi3ExitConfigurationMode(void *c) { return ((Wall *)c)->configuring = false, 0; }
EXPORT int fmi3SetUInt64(void *c, const unsigned *vr, size_t n, const unsigned long *v, size_t room) {
    (void)vr, (void)n, (void)room;
    ((Wall *)c)->size = v[0];
    return ((Wall *)c)->configuring ? 0 : 3;
}
EXPORT int fmi3SetFloat64(void *c, const unsigned *vr, size_t n, const double *v, size_t room) {
    (void)room;
    for (size_t k = 0; k < n; v += many(c, vr[k++])) memcpy(place(c, vr[k]), v, many(c, vr[k]) * sizeof *v);
    return 0;
}
EXPORT int fmi3GetBoolean(void *c, const unsigned *vr, size_t n, bool *v, size_t room) {
    (void)vr, (void)room;
    for (size_t k = 0; k < n; k++) v[k] = ((Wall *)c)->f > 0;
    return 0;
}
EXPORT int fmi3DoStep(void *c, double t, double dt, bool k, bool *e, bool *s, bool *r, double *last) {
    (void)k;
    return step(c, t, dt, e, s, r, last);
}
EXPORT int fmi3EnterInitializationMode(void *c, bool a, double b, double t, bool e, double f) {
    (void)a, (void)b, (void)e, (void)f;
    return start(c, t);
}
EXPORT int fmi3ExitInitializationMode(void *c) { return !c; }
#endif
"""
LAG = """<fmiModelDescription modelName="wall" fmiVersion="3.0" instantiationToken="wall">
<CoSimulation modelIdentifier="wall" fixedInternalStepSize="0.01"/>
<UnitDefinitions><Unit name="mm"><BaseUnit m="1" factor="0.001"/></Unit><Unit name="s"><BaseUnit s="1"/></Unit></UnitDefinitions>
<ModelVariables>
<Float64 name="time" valueReference="9" causality="independent" variability="continuous"/>
<Float64 name="u" valueReference="20" causality="input" unit="mm" start="0 0 0"><Dimension start="3"/></Float64>
<Float64 name="y" valueReference="21" causality="output" unit="mm"><Dimension start="3"/></Float64>
<Float64 name="tau" valueReference="15" causality="parameter" variability="tunable" unit="s" start="0.1"/>
</ModelVariables>
<ModelStructure><Output valueReference="21"/><InitialUnknown valueReference="21"/></ModelStructure></fmiModelDescription>"""
NAMES: tuple[tuple[str, str], ...] = (("z", "input"), ("f", "output"), ("odd", "parameter"), ("at", "parameter"))


def description(version: int, more: str = "", start: str = "", base: int | None = None, brackets: str = "[{}]") -> str:
    """Return a model description; `more` variables are added, `base` is the first index of the flattened array `a`."""
    elements = [] if base is None else [(f"a{brackets.format(base + k)}", "output", 5 + k) for k in range(4)]
    rows = [(name, causality, vr) for vr, (name, causality) in enumerate(NAMES)] + elements
    head = '<?xml version="1.0" encoding="UTF-8"?>\n<fmiModelDescription modelName="wall" '
    tool = 'modelIdentifier="wall" canHandleVariableCommunicationStepSize="true"'
    experiment = f'<DefaultExperiment startTime="{start}"/>' if start else ""

    def words(causality: str) -> str:
        return f'causality="{causality}" variability="{"fixed" if causality == "parameter" else "continuous"}"'

    def value(causality: str) -> str:
        return "" if causality == "output" else ' start="0"'

    outputs = [k for k, (_, causality, _) in enumerate(rows) if causality == "output"]
    if version == 2:
        variables = "".join(
            f'<ScalarVariable name="{name}" valueReference="{vr}" {words(causality)}><Real{value(causality)}/></ScalarVariable>'
            for name, causality, vr in rows
        )
        unknowns = "".join(f'<Unknown index="{k + 1}"/>' for k in outputs)
        structure = f"<Outputs>{unknowns}</Outputs><InitialUnknowns>{unknowns}</InitialUnknowns>"
        head += f'fmiVersion="2.0" guid="wall"><CoSimulation {tool}/>'
    else:
        variables = '<Float64 name="time" valueReference="99" causality="independent" variability="continuous"/>'
        variables += "".join(
            f'<Float64 name="{name}" valueReference="{vr}" {words(causality)}{value(causality)}/>' for name, causality, vr in rows
        )
        structure = "".join(f'<{kind} valueReference="{rows[k][2]}"/>' for kind in ("Output", "InitialUnknown") for k in outputs)
        head += f'fmiVersion="3.0" instantiationToken="wall"><CoSimulation {tool}/>'
    return (
        f"{head}{experiment}<ModelVariables>{variables}{more}</ModelVariables>"
        f"<ModelStructure>{structure}</ModelStructure></fmiModelDescription>"
    )


@cache
def library(version: int) -> tuple[str, bytes]:
    """Return name in the archive and content of an FMU's library for this platform, compiled once in a process.

    FMPy wants every function of the standard to be there: those that `SOURCE` lacks answer fmi2Error or fmi3Error.
    """
    from fmpy import fmi2, fmi3

    slave = fmi2.FMU2Slave if version == 2 else fmi3.FMU3Slave
    missing = [function for function in dir(slave) if function.startswith(f"fmi{version}") and f"{function}(" not in SOURCE]
    rest = "".join(f"EXPORT int {function}(void) {{ return 3; }}\n" for function in missing)
    (target,) = platforms(3, [native()])
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "wall.c").write_text(f"#define FMI_VERSION {version}\n{SOURCE}{rest}")
        content = compile_library(Path(folder), ["wall.c"], target)
    return f"binaries/{target.tuple_3 if version == 3 else target.folder_2}/wall{target.suffix}", content


def build_wall(path: Path, version: int, text: str = "") -> Path:
    """Write the FMU for this platform, with `text` as its model description."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", text or description(version))
        archive.writestr(*library(version))
    return path
