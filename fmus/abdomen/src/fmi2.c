/* FMI 2.0 for co-simulation and model exchange. Every failure is an fmi2Error with a message, and leaves the instance as it was. */
#include "fmi2Functions.h"

#include <stdlib.h>
#include <string.h>

#include "exchange.h"

typedef struct {
    Component *core;
    const fmi2CallbackFunctions *callbacks;
    char *name;
    double start, stop;
    int has_stop, set_up;
} Instance;

/* The message is the format itself, so that a logger that cannot take further arguments shows it too. */
static void forward(void *environment, const char *message) {
    const Instance *i = environment;
    char escaped[1024];
    size_t k = 0;
    if (!i->callbacks || !i->callbacks->logger) return;
    for (; *message && k + 3 < sizeof escaped; message++) {
        if (*message == '%') escaped[k++] = '%';
        escaped[k++] = *message;
    }
    escaped[k] = 0;
    i->callbacks->logger(i->callbacks->componentEnvironment, i->name ? i->name : "abdomen", fmi2Error, "logStatusError", escaped);
}

static fmi2Status status(int ok) { return ok ? fmi2OK : fmi2Error; }

static Component *core_of(fmi2Component c) { return c ? ((Instance *)c)->core : NULL; }

static fmi2Status refuse(fmi2Component component, const char *what) {
    const Component *c = core_of(component);
    if (c) component_say(c, "%s is not supported by this FMU", what);
    return fmi2Error;
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }

const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean loggingOn, size_t nCategories, const fmi2String categories[]) {
    (void)loggingOn;
    for (size_t i = 0; i < nCategories; i++) {
        if (!categories || !categories[i] || strcmp(categories[i], "logStatusError") != 0) {
            return refuse(c, "a log category other than logStatusError");
        }
    }
    return status(core_of(c) != NULL);
}

static int hexadecimal(char c) {
    if (c >= '0' && c <= '9') return c - '0';
    if (c >= 'a' && c <= 'f') return c - 'a' + 10;
    if (c >= 'A' && c <= 'F') return c - 'A' + 10;
    return -1;
}

/* The path of a file URI: file:///a%20b, file:/a, file:///C:/a; NULL if it is none. */
static char *path_of(const char *uri) {
    char *path, *out;
    const char *in = uri;
    if (!uri || strncmp(uri, "file:", 5) != 0) return NULL;
    in += 5;
    if (in[0] == '/' && in[1] == '/') {
        in += 2;
        while (*in && *in != '/') in++; /* the host, normally empty */
    }
    if (in[0] == '/' && in[1] && in[2] == ':') in++; /* a Windows drive */
    out = path = malloc(strlen(in) + 1);
    if (!path) return NULL;
    while (*in) {
        if (in[0] == '%' && hexadecimal(in[1]) >= 0 && hexadecimal(in[2]) >= 0) {
            *out++ = (char)(16 * hexadecimal(in[1]) + hexadecimal(in[2]));
            in += 3;
        } else {
            *out++ = *in++;
        }
    }
    *out = 0;
    return path;
}

fmi2Component fmi2Instantiate(fmi2String instanceName, fmi2Type fmuType, fmi2String fmuGUID, fmi2String fmuResourceLocation,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean loggingOn) {
    Instance *i = calloc(1, sizeof *i);
    char *path;
    (void)visible, (void)loggingOn;
    if (!i) return NULL;
    i->callbacks = functions;
    i->name = malloc(instanceName ? strlen(instanceName) + 1 : 1);
    if (i->name) strcpy(i->name, instanceName ? instanceName : "");
    path = path_of(fmuResourceLocation);
    if (path) i->core = component_new(path, fmuGUID, fmuType == fmi2ModelExchange, forward, i);
    else forward(i, "the location of the resources is not a file URI");
    free(path);
    if (i->core) return i;
    free(i->name);
    free(i);
    return NULL;
}

void fmi2FreeInstance(fmi2Component c) {
    Instance *i = c;
    if (!i) return;
    component_free(i->core);
    free(i->name);
    free(i);
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance, fmi2Real startTime,
                               fmi2Boolean stopTimeDefined, fmi2Real stopTime) {
    Instance *i = c;
    (void)toleranceDefined, (void)tolerance;
    if (!core_of(c) || !component_expects(i->core, i->core->phase == PHASE_INSTANTIATED, "setting up the experiment")) return fmi2Error;
    i->start = startTime;
    i->stop = stopTimeDefined ? stopTime : 0;
    i->has_stop = stopTimeDefined;
    i->set_up = 1;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    const Instance *i = c;
    if (!core_of(c) || !component_expects(i->core, i->set_up, "initialization before setting up the experiment")) return fmi2Error;
    return status(component_enter_initialization(i->core, i->start, i->has_stop, i->stop));
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return status(c && component_exit_initialization(core_of(c))); }

fmi2Status fmi2Terminate(fmi2Component c) { return status(c && component_terminate(core_of(c))); }

fmi2Status fmi2Reset(fmi2Component c) {
    Instance *i = c;
    if (!i) return fmi2Error;
    i->set_up = 0;
    return status(component_reset(i->core));
}

static fmi2Status get(Component *c, Type type, size_t size, const fmi2ValueReference *vr, size_t n, char *values) {
    Slot slot;
    if (!c || (n && (!vr || !values))) return fmi2Error;
    for (size_t i = 0; i < n; i++, values += size) {
        if (!component_find(c, vr[i], type, 1, &slot)) return fmi2Error;
        component_read(c, &slot, values);
    }
    return fmi2OK;
}

/* Sets all of the variables, or none of them if one value is refused. */
static fmi2Status set(Component *c, Type type, size_t size, const fmi2ValueReference *vr, size_t n, const char *values) {
    Slot slot;
    if (!c || (n && (!vr || !values))) return fmi2Error;
    for (size_t i = 0; i < n; i++) {
        if (!component_find(c, vr[i], type, 1, &slot) || !component_check(c, &slot, values + i * size)) return fmi2Error;
    }
    for (size_t i = 0; i < n; i++) {
        component_find(c, vr[i], type, 1, &slot);
        component_write(c, &slot, values + i * size);
    }
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Real value[]) {
    return get(core_of(c), TYPE_REAL, sizeof *value, vr, nvr, (char *)value);
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Real value[]) {
    return set(core_of(c), TYPE_REAL, sizeof *value, vr, nvr, (const char *)value);
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Integer value[]) {
    return get(core_of(c), TYPE_INTEGER, sizeof *value, vr, nvr, (char *)value);
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Integer value[]) {
    return set(core_of(c), TYPE_INTEGER, sizeof *value, vr, nvr, (const char *)value);
}

/* Types that no variable has: only an empty list can be asked for. */
#define NO_VARIABLES(name, type)                                                                                    \
    fmi2Status fmi2Get##name(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, type value[]) {             \
        (void)vr, (void)value;                                                                                      \
        return nvr ? refuse(c, "a variable of type " #name) : status(c != NULL);                                     \
    }                                                                                                               \
    fmi2Status fmi2Set##name(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const type value[]) {       \
        (void)vr, (void)value;                                                                                      \
        return nvr ? refuse(c, "a variable of type " #name) : status(c != NULL);                                     \
    }

NO_VARIABLES(Boolean, fmi2Boolean)
NO_VARIABLES(String, fmi2String)

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
    const Component *core = core_of(c);
    if (!core || !FMUstate) return fmi2Error;
    if (!*FMUstate) *FMUstate = malloc(component_snapshot_size(core));
    if (!*FMUstate) return refuse(c, "saving the state without memory");
    component_save(core, *FMUstate);
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate FMUstate) {
    Component *core = core_of(c);
    return status(core && FMUstate && component_load(core, FMUstate, component_snapshot_size(core)));
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
    if (!core_of(c)) return fmi2Error;
    if (FMUstate) {
        free(*FMUstate);
        *FMUstate = NULL;
    }
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate FMUstate, size_t *size) {
    const Component *core = core_of(c);
    if (!core || !FMUstate || !size) return fmi2Error;
    *size = component_snapshot_size(core);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate FMUstate, fmi2Byte serializedState[], size_t size) {
    const Component *core = core_of(c);
    if (!core || !FMUstate || !serializedState || size < component_snapshot_size(core)) return refuse(c, "so small a buffer");
    memcpy(serializedState, FMUstate, component_snapshot_size(core));
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte serializedState[], size_t size, fmi2FMUstate *FMUstate) {
    const Component *core = core_of(c);
    if (!core || !serializedState || !FMUstate) return fmi2Error;
    if (size != component_snapshot_size(core)) return refuse(c, "a serialized state of another size");
    if (!*FMUstate) *FMUstate = malloc(size);
    if (!*FMUstate) return refuse(c, "restoring the state without memory");
    memcpy(*FMUstate, serializedState, size);
    return fmi2OK;
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference vUnknown_ref[], size_t nUnknown,
                                        const fmi2ValueReference vKnown_ref[], size_t nKnown, const fmi2Real dvKnown[],
                                        fmi2Real dvUnknown[]) {
    Component *core = core_of(c);
    const Derivative derivative = {1, vUnknown_ref, vKnown_ref, nUnknown, nKnown, dvKnown, nKnown, dvUnknown, nUnknown};
    if ((nUnknown && (!vUnknown_ref || !dvUnknown)) || (nKnown && (!vKnown_ref || !dvKnown))) return fmi2Error;
    return status(core && exchange_derive(core, &derivative));
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Integer order[],
                                       const fmi2Real value[]) {
    (void)vr, (void)order, (void)value;
    return nvr ? refuse(c, "an input derivative") : status(c != NULL);
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Integer order[],
                                        fmi2Real value[]) {
    (void)vr, (void)order, (void)value;
    return nvr ? refuse(c, "an output derivative") : status(c != NULL);
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real currentCommunicationPoint, fmi2Real communicationStepSize,
                      fmi2Boolean noSetFMUStatePriorToCurrentPoint) {
    (void)noSetFMUStatePriorToCurrentPoint;
    return status(c && component_step(core_of(c), currentCommunicationPoint, communicationStepSize));
}

fmi2Status fmi2CancelStep(fmi2Component c) { return refuse(c, "an asynchronous step"); }

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind s, fmi2Status *value) {
    (void)s, (void)value;
    return refuse(c, "an asynchronous step");
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind s, fmi2Real *value) {
    if (!core_of(c) || s != fmi2LastSuccessfulTime || !value) return refuse(c, "an asynchronous step");
    *value = core_of(c)->tissue->state.time;
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind s, fmi2Integer *value) {
    (void)s, (void)value;
    return refuse(c, "an asynchronous step");
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind s, fmi2Boolean *value) {
    if (!core_of(c) || s != fmi2Terminated || !value) return refuse(c, "an asynchronous step");
    *value = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind s, fmi2String *value) {
    (void)s, (void)value;
    return refuse(c, "an asynchronous step");
}

/* Model exchange. */

fmi2Status fmi2EnterEventMode(fmi2Component c) {
    Component *core = core_of(c);
    return status(core && exchange_enter(core, PHASE_EVENT));
}

/* There are none, and no events: contact is continuous. */
fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *eventInfo) {
    static const fmi2EventInfo NOTHING = {fmi2False, fmi2False, fmi2False, fmi2False, fmi2False, 0};
    Component *core = core_of(c);
    if (!core || !eventInfo || !exchange_ready(core, "new discrete states")) return fmi2Error;
    *eventInfo = NOTHING;
    return fmi2OK;
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) {
    Component *core = core_of(c);
    return status(core && exchange_enter(core, PHASE_CONTINUOUS));
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean noSetFMUStatePriorToCurrentPoint, fmi2Boolean *enterEventMode,
                                       fmi2Boolean *terminateSimulation) {
    Component *core = core_of(c);
    (void)noSetFMUStatePriorToCurrentPoint;
    if (!core || !exchange_ready(core, "a completed integrator step")) return fmi2Error;
    if (enterEventMode) *enterEventMode = fmi2False;
    if (terminateSimulation) *terminateSimulation = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time) {
    Component *core = core_of(c);
    return status(core && exchange_time(core, time));
}

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t nx) {
    Component *core = core_of(c);
    return status(core && x && exchange_set_states(core, x, nx));
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real derivatives[], size_t nx) {
    Component *core = core_of(c);
    return status(core && derivatives && exchange_rates(core, derivatives, nx));
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real eventIndicators[], size_t ni) {
    (void)eventIndicators;
    return ni ? refuse(c, "an event indicator") : status(c != NULL);
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t nx) {
    Component *core = core_of(c);
    return status(core && x && exchange_get_states(core, x, nx));
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x_nominal[], size_t nx) {
    Component *core = core_of(c);
    return status(core && x_nominal && exchange_nominals(core, x_nominal, nx));
}
