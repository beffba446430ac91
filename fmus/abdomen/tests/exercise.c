/* Drives the FMU as a master would, and as a careless one would, for the sanitizers. Arguments: resources, token. */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static int failures;

static void expect(int ok, const char *what) {
    if (ok) return;
    failures++;
    printf("not so: %s\n", what);
}

#if FMI_VERSION == 3
#include "fmi3Functions.h"

typedef fmi3Instance Handle;
typedef fmi3FMUState Saved;
static int messages;

static void log_message(fmi3InstanceEnvironment e, fmi3Status s, fmi3String category, fmi3String message) {
    (void)e, (void)s, (void)category;
    messages += strlen(message) > 10;
}

static Handle create(const char *resources, const char *token) {
    return fmi3InstantiateCoSimulation("x", token, resources, 0, 0, 0, 0, NULL, 0, NULL, log_message, NULL);
}
static void discard(Handle h) { fmi3FreeInstance(h); }
static int initialise(Handle h) {
    return fmi3EnterInitializationMode(h, 0, 0, 0, 1, 100) == fmi3OK && fmi3ExitInitializationMode(h) == fmi3OK;
}
static int place(Handle h, double x, double y, double z) {
    const fmi3ValueReference vr = 1;
    const double p[3] = {x, y, z};
    return fmi3SetFloat64(h, &vr, 1, p, 3) == fmi3OK;
}
static int step(Handle h, double t, double dt) {
    bool a, b, c;
    double last;
    return fmi3DoStep(h, t, dt, 1, &a, &b, &c, &last) == fmi3OK;
}
static double force(Handle h) {
    const fmi3ValueReference vr = 10;
    double f[3] = {0, 0, 0};
    expect(fmi3GetFloat64(h, &vr, 1, f, 3) == fmi3OK, "get force");
    return f[2];
}
static int set_one(Handle h, unsigned vr, double value) { return fmi3SetFloat64(h, &vr, 1, &value, 1) == fmi3OK; }
static int get_none(Handle h) {
    const fmi3ValueReference vr = 4711;
    double value;
    return fmi3GetFloat64(h, &vr, 1, &value, 1) == fmi3OK;
}
static void read_all(Handle h, long n, long m) {
    static const unsigned singles[] = {16, 23, 24, 25, 27, 28, 30}, fields[] = {5000, 5005, 5006}, triples[] = {5001, 5002, 5003, 5004};
    const unsigned contacts = 26, lesion = 5007, triangles = 5008;
    double one, *many = malloc(3 * (size_t)n * sizeof *many);
    int32_t count, *whole = malloc(3 * (size_t)m * sizeof *whole);
    for (size_t k = 0; k < sizeof singles / sizeof *singles; k++) expect(fmi3GetFloat64(h, singles + k, 1, &one, 1) == fmi3OK, "get one");
    for (size_t k = 0; k < 3; k++) expect(fmi3GetFloat64(h, fields + k, 1, many, (size_t)n) == fmi3OK, "get field");
    for (size_t k = 0; k < 4; k++) expect(fmi3GetFloat64(h, triples + k, 1, many, 3 * (size_t)n) == fmi3OK, "get triples");
    expect(fmi3GetFloat64(h, fields, 1, many, (size_t)n - 1) != fmi3OK, "too little room is an error");
    expect(fmi3GetInt32(h, &contacts, 1, &count, 1) == fmi3OK, "get contacts");
    expect(fmi3GetInt32(h, &lesion, 1, whole, (size_t)n) == fmi3OK, "get lesion");
    expect(fmi3GetInt32(h, &triangles, 1, whole, 3 * (size_t)m) == fmi3OK, "get triangles");
    expect(fmi3GetInt32(h, fields, 1, whole, (size_t)n) != fmi3OK, "another type is an error");
    free(many);
    free(whole);
}
static Saved save(Handle h) {
    Saved s = NULL;
    expect(fmi3GetFMUState(h, &s) == fmi3OK, "save");
    return s;
}
static int load(Handle h, Saved s) { return fmi3SetFMUState(h, s) == fmi3OK; }
static void drop(Handle h, Saved *s) { fmi3FreeFMUState(h, s); }
static void serialise(Handle h, Saved s) {
    size_t size = 0;
    unsigned char *bytes;
    Saved copy = NULL;
    expect(fmi3SerializedFMUStateSize(h, s, &size) == fmi3OK && size > 1000, "size of state");
    bytes = malloc(size);
    expect(fmi3SerializeFMUState(h, s, bytes, size) == fmi3OK, "serialise");
    expect(fmi3SerializeFMUState(h, s, bytes, size - 1) != fmi3OK, "too small a buffer is an error");
    expect(fmi3DeserializeFMUState(h, bytes, size - 1, &copy) != fmi3OK, "too few bytes are an error");
    expect(fmi3DeserializeFMUState(h, bytes, size, &copy) == fmi3OK && load(h, copy), "deserialise");
    drop(h, &copy);
    free(bytes);
}
static Handle create_exchange(const char *resources, const char *token) {
    return fmi3InstantiateModelExchange("x", token, resources, 0, 0, NULL, log_message);
}
static int start_exchange(Handle h) {
    bool a, b, c, d, e;
    double next;
    return initialise(h) && fmi3UpdateDiscreteStates(h, &a, &b, &c, &d, &e, &next) == fmi3OK && !a && !b && !e &&
           fmi3EnterContinuousTimeMode(h) == fmi3OK;
}
static size_t states_of(Handle h, long n) {
    size_t count = 0;
    (void)n;
    expect(fmi3GetNumberOfContinuousStates(h, &count) == fmi3OK, "number of states");
    return count;
}
static int set_time(Handle h, double t) { return fmi3SetTime(h, t) == fmi3OK; }
static int get_x(Handle h, double *x, size_t n) { return fmi3GetContinuousStates(h, x, n) == fmi3OK; }
static int set_x(Handle h, const double *x, size_t n) { return fmi3SetContinuousStates(h, x, n) == fmi3OK; }
static int get_dx(Handle h, double *dx, size_t n) { return fmi3GetContinuousStateDerivatives(h, dx, n) == fmi3OK; }
static int get_nominals(Handle h, double *x, size_t n) { return fmi3GetNominalsOfContinuousStates(h, x, n) == fmi3OK; }
static int complete(Handle h) {
    bool a, b;
    return fmi3CompletedIntegratorStep(h, 1, &a, &b) == fmi3OK && !a && !b;
}
static int derive(Handle h, unsigned unknown, unsigned known, double *change) {
    const double seed[3] = {0, 0, -1};
    const fmi3ValueReference u = unknown, k = known;
    return fmi3GetDirectionalDerivative(h, &u, 1, &k, 1, seed, 3, change, 3) == fmi3OK;
}
static int reset(Handle h) { return fmi3Reset(h) == fmi3OK; }
static int end(Handle h) { return fmi3Terminate(h) == fmi3OK; }
#else
#include <stdarg.h>

#include "fmi2Functions.h"

typedef fmi2Component Handle;
typedef fmi2FMUstate Saved;
static int messages;

static void log_message(fmi2ComponentEnvironment e, fmi2String name, fmi2Status s, fmi2String category, fmi2String format, ...) {
    char text[600];
    va_list arguments;
    (void)e, (void)name, (void)s, (void)category;
    va_start(arguments, format);
    vsnprintf(text, sizeof text, format, arguments);
    va_end(arguments);
    messages += strlen(text) > 10;
}

static const fmi2CallbackFunctions callbacks = {log_message, calloc, free, NULL, NULL};

static Handle create(const char *resources, const char *token) {
    char uri[4096];
    snprintf(uri, sizeof uri, "file://%s", resources);
    return fmi2Instantiate("x", fmi2CoSimulation, token, uri, &callbacks, 0, 0);
}
static void discard(Handle h) { fmi2FreeInstance(h); }
static int initialise(Handle h) {
    return fmi2SetupExperiment(h, 0, 0, 0, 1, 100) == fmi2OK && fmi2EnterInitializationMode(h) == fmi2OK &&
           fmi2ExitInitializationMode(h) == fmi2OK;
}
static int place(Handle h, double x, double y, double z) {
    const fmi2ValueReference vr[3] = {1, 2, 3};
    const double p[3] = {x, y, z};
    return fmi2SetReal(h, vr, 3, p) == fmi2OK;
}
static int step(Handle h, double t, double dt) { return fmi2DoStep(h, t, dt, 1) == fmi2OK; }
static double force(Handle h) {
    const fmi2ValueReference vr = 12;
    double f = 0;
    expect(fmi2GetReal(h, &vr, 1, &f) == fmi2OK, "get force");
    return f;
}
static int set_one(Handle h, unsigned vr, double value) { return fmi2SetReal(h, &vr, 1, &value) == fmi2OK; }
static int get_none(Handle h) {
    const fmi2ValueReference vr = 4711;
    double value;
    return fmi2GetReal(h, &vr, 1, &value) == fmi2OK;
}
static void read_all(Handle h, long n, long m) {
    const unsigned contacts = 26;
    int32_t count;
    double value;
    (void)n, (void)m;
    for (unsigned vr = 1; vr < 96; vr++) {
        if (vr != 26 && vr != 29 && vr != 36 && vr != 38) expect(fmi2GetReal(h, &vr, 1, &value) == fmi2OK, "get one");
    }
    for (unsigned vr = 1000; vr < 1064; vr++) expect(fmi2GetReal(h, &vr, 1, &value) == fmi2OK, "get a sample");
    for (unsigned vr = 1500; vr < 1692; vr++) expect(fmi2GetReal(h, &vr, 1, &value) == fmi2OK, "get a sample's place");
    expect(fmi2GetInteger(h, &contacts, 1, &count) == fmi2OK, "get contacts");
}
static Saved save(Handle h) {
    Saved s = NULL;
    expect(fmi2GetFMUstate(h, &s) == fmi2OK, "save");
    return s;
}
static int load(Handle h, Saved s) { return fmi2SetFMUstate(h, s) == fmi2OK; }
static void drop(Handle h, Saved *s) { fmi2FreeFMUstate(h, s); }
static void serialise(Handle h, Saved s) {
    size_t size = 0;
    char *bytes;
    Saved copy = NULL;
    expect(fmi2SerializedFMUstateSize(h, s, &size) == fmi2OK && size > 1000, "size of state");
    bytes = malloc(size);
    expect(fmi2SerializeFMUstate(h, s, bytes, size) == fmi2OK, "serialise");
    expect(fmi2DeSerializeFMUstate(h, bytes, size - 1, &copy) != fmi2OK, "too few bytes are an error");
    expect(fmi2DeSerializeFMUstate(h, bytes, size, &copy) == fmi2OK && load(h, copy), "deserialise");
    drop(h, &copy);
    free(bytes);
}
static Handle create_exchange(const char *resources, const char *token) {
    char uri[4096];
    snprintf(uri, sizeof uri, "file://%s", resources);
    return fmi2Instantiate("x", fmi2ModelExchange, token, uri, &callbacks, 0, 0);
}
static int start_exchange(Handle h) {
    fmi2EventInfo info;
    return initialise(h) && fmi2NewDiscreteStates(h, &info) == fmi2OK && !info.newDiscreteStatesNeeded && !info.nextEventTimeDefined &&
           fmi2EnterContinuousTimeMode(h) == fmi2OK;
}
static size_t states_of(Handle h, long n) {
    (void)h;
    return 3 * (size_t)n + 4; /* the tests' phantom has two branches */
}
static int set_time(Handle h, double t) { return fmi2SetTime(h, t) == fmi2OK; }
static int get_x(Handle h, double *x, size_t n) { return fmi2GetContinuousStates(h, x, n) == fmi2OK; }
static int set_x(Handle h, const double *x, size_t n) { return fmi2SetContinuousStates(h, x, n) == fmi2OK; }
static int get_dx(Handle h, double *dx, size_t n) { return fmi2GetDerivatives(h, dx, n) == fmi2OK; }
static int get_nominals(Handle h, double *x, size_t n) { return fmi2GetNominalsOfContinuousStates(h, x, n) == fmi2OK; }
static int complete(Handle h) {
    fmi2Boolean a, b;
    return fmi2CompletedIntegratorStep(h, 1, &a, &b) == fmi2OK && !a && !b;
}
static int derive(Handle h, unsigned unknown, unsigned known, double *change) {
    const double seed[3] = {0, 0, -1};
    const fmi2ValueReference u[3] = {unknown, unknown + 1, unknown + 2}, k[3] = {known, known + 1, known + 2};
    return fmi2GetDirectionalDerivative(h, u, 3, k, 3, seed, change) == fmi2OK;
}
static int reset(Handle h) { return fmi2Reset(h) == fmi2OK; }
static int end(Handle h) { return fmi2Terminate(h) == fmi2OK; }
#endif

/* Presses at the umbilicus's side and slides; returns the force at the end. */
static double press(Handle h, double *t) {
    for (int k = 0; k < 300; k++, *t += 1e-3) {
        expect(place(h, 1e-4 * k, 0.05, 0.02 - 5e-5 * k), "place");
        expect(step(h, *t, 1e-3), "step");
    }
    return force(h);
}

/* Model exchange: integrates by explicit Euler while the sphere presses; states are kept in heap memory of their exact size. */
static void exchange(const char *resources, const char *token, long n) {
    Handle h = create_exchange(resources, token);
    Saved saved;
    const size_t states = h ? states_of(h, n) : 0;
    double *x = calloc(states, sizeof *x), *dx = calloc(states, sizeof *dx), change[3], pressed;
    expect(h && create_exchange(resources, "{wrong}") == NULL, "an instance for model exchange");
    expect(!get_dx(h, dx, states) && !set_time(h, 0), "no rates before initialization");
    expect(start_exchange(h), "to continuous time");
    expect(!step(h, 0, 1e-3), "no step in model exchange");
    for (int k = 0; k < 200; k++) {
        expect(place(h, 0, 0.05, 0.02 - 7e-5 * k) && set_time(h, 1e-3 * k), "place and time");
        expect(get_x(h, x, states) && get_dx(h, dx, states), "states and rates");
        for (size_t i = 0; i < states; i++) x[i] += 1e-3 * dx[i];
        expect(set_x(h, x, states) && complete(h), "set states");
    }
    pressed = force(h);
    expect(pressed > 0.5, "there is a force");
    expect(derive(h, 10, 1, change) && change[2] > 0, "deeper is more");
    expect(!derive(h, 10, 40, change) && !derive(h, 40, 1, change), "parameters have no derivative");
    expect(!get_x(h, x, states - 1) && !set_x(h, x, states - 1) && get_nominals(h, dx, states), "another number of states is an error");
    saved = save(h);
    x[0] = NAN;
    expect(!set_x(h, x, states) && !set_time(h, NAN) && !place(h, NAN, 0, 0), "no impossible states, time or place");
    expect(force(h) == pressed, "after errors the state is as it was");
    for (size_t i = 0; i < states; i++) x[i] = 0;
    expect(set_x(h, x, states) && place(h, 0, 0, 1) && force(h) == 0, "away at rest");
    expect(load(h, saved) && force(h) == pressed, "rolled back");
    expect(place(h, 0, 0.05, -0.5) && get_dx(h, dx, states) && place(h, 9, -9, 9) && get_dx(h, dx, states), "far in, far out");
    expect(derive(h, 10, 1, change), "a derivative far away");
    drop(h, &saved);
    expect(reset(h) && start_exchange(h) && force(h) == 0 && end(h) && !set_time(h, 1), "again, and to the end");
    discard(h);
    free(x);
    free(dx);
}

int main(int argc, char **argv) {
    Handle a, b;
    Saved saved;
    double t = 0, later, first, second;
    if (argc == 3) { /* a phantom that may be damaged: whatever it does, no crash */
        a = create(argv[1], argv[2]);
        if (a && initialise(a)) {
            for (int k = 0; k < 5; k++) {
                place(a, 0, 0.05, 0.005);
                step(a, 1e-3 * k, 1e-3);
            }
        }
        discard(a);
        return 0;
    }
    if (argc != 5) return 2;
    expect(create("/nowhere/", argv[2]) == NULL, "no resources, no instance");
    expect(create(argv[1], "{wrong}") == NULL, "another token, no instance");
    a = create(argv[1], argv[2]);
    b = create(argv[1], argv[2]);
    expect(a && b, "two instances");
    if (!a || !b) return 1;
    expect(!step(a, 0, 1e-3), "no step before initialization");
    expect(set_one(a, 31, 1.5) && set_one(a, 32, 0.02), "parameters before initialization");
    expect(initialise(a) && initialise(b), "initialise");
    expect(!set_one(a, 31, 2.0), "a fixed parameter cannot be set later");
    expect(set_one(a, 30, 0.02), "a tunable one can");
    first = press(a, &t);
    expect(first > 0.5, "there is a force");
    expect(fabs(force(b)) == 0, "the other instance knows nothing of it");
    read_all(a, atol(argv[3]), atol(argv[4]));
    saved = save(a);
    later = t;
    second = press(a, &later);
    expect(!step(a, t, 1e-3), "no step back");
    expect(!step(a, later, -1e-3) && !step(a, later, NAN) && !step(a, NAN, 1e-3) && !step(a, later, 1e9), "no impossible step");
    expect(!place(a, NAN, 0, 0) && !place(a, 0, INFINITY, 0) && !place(a, 0, 0, 1e6), "no impossible place");
    expect(!set_one(a, 30, -1) && !set_one(a, 10, 1) && !get_none(a), "no impossible value or variable");
    expect(force(a) == second, "after errors the state is as it was");
    expect(load(a, saved) && force(a) == first, "rolled back");
    later = t;
    expect(press(a, &later) == second, "again the same, to the bit");
    serialise(a, saved);
    expect(load(b, saved) && force(b) == first, "a state moves to another instance, with its parameters");
    later = t;
    expect(press(b, &later) == second, "which goes on alike");
    drop(a, &saved);
    for (int k = 0; k < 20; k++) expect(place(a, 0.3 * k, -0.2 * k, 0.01), "far away") , step(a, 0.3 + 0.05 * k, 0.05);
    expect(reset(a) && initialise(a), "after a reset it starts again");
    expect(step(a, 0, 0.1), "a long step");
    expect(!step(a, 99.95, 1.0), "no step beyond");
    expect(end(a) && !step(a, 0.1, 1e-3), "no step after the end");
    discard(a);
    discard(b);
    exchange(argv[1], argv[2], atol(argv[3]));
    expect(messages > 10, "errors had messages");
    printf("%d failures, %d messages\n", failures, messages);
    return failures ? 1 : 0;
}
