"""An FMU that is not ours, built from a few lines of C: three first-order lags in millimetres, FMI 3.0."""

import zipfile
from pathlib import Path

from odd_fmu import library

SOURCE = """
#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#define EXPORT __attribute__((visibility("default")))

typedef struct { double u[3], y[3], tau; } Lag;

static Lag *lag_new(void) {
    Lag *lag = calloc(1, sizeof *lag);
    if (lag) lag->tau = 0.1;
    return lag;
}

static int lag_step(Lag *lag, double dt) {
    const double share = 1 - exp(-dt / lag->tau);
    if (fabs(dt - 0.01) > 1e-9) return 3; /* a fixed step: 10 ms */
    for (int k = 0; k < 3; k++) lag->y[k] += share * (lag->u[k] - lag->y[k]);
    return 0;
}

EXPORT void *fmi3InstantiateCoSimulation(const char *n, const char *g, const char *r, bool v, bool l, bool e, bool w,
                                         const unsigned *i, size_t m, void *x, void *f, void *u) {
    (void)n, (void)r, (void)v, (void)l, (void)e, (void)w, (void)i, (void)m, (void)x, (void)f, (void)u;
    return strcmp(g, "lag") ? NULL : lag_new();
}
EXPORT void fmi3FreeInstance(void *c) { free(c); }
static size_t at(unsigned vr) { return vr * 3; }
static size_t many(unsigned vr) { return vr == 2 ? 1 : 3; }
EXPORT int fmi3GetFloat64(void *c, const unsigned *vr, size_t n, double *v, size_t room) {
    (void)room;
    for (size_t k = 0; k < n; v += many(vr[k++])) memcpy(v, (double *)c + at(vr[k]), many(vr[k]) * sizeof *v);
    return 0;
}
EXPORT int fmi3SetFloat64(void *c, const unsigned *vr, size_t n, const double *v, size_t room) {
    (void)room;
    for (size_t k = 0; k < n; v += many(vr[k++])) memcpy((double *)c + at(vr[k]), v, many(vr[k]) * sizeof *v);
    return 0;
}
EXPORT int fmi3DoStep(void *c, double t, double dt, bool k, bool *e, bool *s, bool *r, double *last) {
    (void)k;
    *e = *s = *r = false;
    *last = t + dt;
    return lag_step(c, dt);
}
EXPORT int fmi3EnterInitializationMode(void *c, bool a, double b, double d, bool e, double f) {
    (void)a, (void)b, (void)d, (void)e, (void)f;
    return !c;
}
EXPORT int fmi3ExitInitializationMode(void *c) { return !c; }
"""

DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription modelName="lag" fmiVersion="3.0" instantiationToken="lag">
<CoSimulation modelIdentifier="lag" fixedInternalStepSize="0.01"/>
<UnitDefinitions><Unit name="mm"><BaseUnit m="1" factor="0.001"/></Unit><Unit name="s"><BaseUnit s="1"/></Unit></UnitDefinitions>
<ModelVariables>
<Float64 name="time" valueReference="9" causality="independent" variability="continuous"/>
<Float64 name="u" valueReference="0" causality="input" unit="mm" start="0 0 0"><Dimension start="3"/></Float64>
<Float64 name="y" valueReference="1" causality="output" unit="mm"><Dimension start="3"/></Float64>
<Float64 name="tau" valueReference="2" causality="parameter" variability="tunable" unit="s" start="0.1"/>
</ModelVariables>
<ModelStructure><Output valueReference="1"/><InitialUnknown valueReference="1"/></ModelStructure></fmiModelDescription>"""


def build_lag(folder: Path) -> Path:
    """Write lag.fmu for this platform."""
    path = folder / "lag.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", DESCRIPTION)
        archive.writestr("resources/readme.txt", "nothing")
        archive.writestr(*library("lag", SOURCE, 3))
    return path
