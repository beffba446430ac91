/* FMI 3.0 for co-simulation and model exchange. Every failure is an fmi3Error with a message, and leaves the instance as it was. */
#include "fmi3Functions.h"

#include <stdlib.h>
#include <string.h>

#include "exchange.h"

typedef struct {
    Component *core;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
} Instance;

static void forward(void *environment, const char *message) {
    const Instance *instance = environment;
    if (instance->log) instance->log(instance->environment, fmi3Error, "logStatusError", message);
}

static fmi3Status status(int ok) { return ok ? fmi3OK : fmi3Error; }

static Component *core_of(fmi3Instance instance) { return instance ? ((Instance *)instance)->core : NULL; }

static fmi3Status refuse(fmi3Instance instance, const char *what) {
    const Component *c = core_of(instance);
    if (c) component_say(c, "%s is not supported by this FMU", what);
    return fmi3Error;
}

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean loggingOn, size_t nCategories, const fmi3String categories[]) {
    (void)loggingOn;
    for (size_t i = 0; i < nCategories; i++) {
        if (!categories || !categories[i] || strcmp(categories[i], "logStatusError") != 0) {
            return refuse(instance, "a log category other than logStatusError");
        }
    }
    return status(core_of(instance) != NULL);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
                                         fmi3Boolean visible, fmi3Boolean loggingOn, fmi3Boolean eventModeUsed,
                                         fmi3Boolean earlyReturnAllowed, const fmi3ValueReference requiredIntermediateVariables[],
                                         size_t nRequiredIntermediateVariables, fmi3InstanceEnvironment instanceEnvironment,
                                         fmi3LogMessageCallback logMessage, fmi3IntermediateUpdateCallback intermediateUpdate) {
    Instance *instance = calloc(1, sizeof *instance);
    (void)instanceName, (void)visible, (void)loggingOn, (void)earlyReturnAllowed, (void)intermediateUpdate;
    (void)requiredIntermediateVariables;
    if (!instance) return NULL;
    instance->environment = instanceEnvironment;
    instance->log = logMessage;
    if (eventModeUsed || nRequiredIntermediateVariables) {
        forward(instance, "this FMU has neither event mode nor intermediate variables");
    } else {
        instance->core = component_new(resourcePath, instantiationToken, 0, forward, instance);
    }
    if (instance->core) return instance;
    free(instance);
    return NULL;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
                                          fmi3Boolean visible, fmi3Boolean loggingOn, fmi3InstanceEnvironment instanceEnvironment,
                                          fmi3LogMessageCallback logMessage) {
    Instance *instance = calloc(1, sizeof *instance);
    (void)instanceName, (void)visible, (void)loggingOn;
    if (!instance) return NULL;
    instance->environment = instanceEnvironment;
    instance->log = logMessage;
    instance->core = component_new(resourcePath, instantiationToken, 1, forward, instance);
    if (instance->core) return instance;
    free(instance);
    return NULL;
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
                                               fmi3Boolean visible, fmi3Boolean loggingOn,
                                               fmi3InstanceEnvironment instanceEnvironment, fmi3LogMessageCallback logMessage,
                                               fmi3ClockUpdateCallback clockUpdate, fmi3LockPreemptionCallback lockPreemption,
                                               fmi3UnlockPreemptionCallback unlockPreemption) {
    (void)instanceName, (void)instantiationToken, (void)resourcePath, (void)visible, (void)loggingOn;
    (void)clockUpdate, (void)lockPreemption, (void)unlockPreemption;
    if (logMessage) logMessage(instanceEnvironment, fmi3Error, "logStatusError", "this FMU is not for scheduled execution");
    return NULL;
}

void fmi3FreeInstance(fmi3Instance instance) {
    if (!instance) return;
    component_free(core_of(instance));
    free(instance);
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean toleranceDefined, fmi3Float64 tolerance,
                                       fmi3Float64 startTime, fmi3Boolean stopTimeDefined, fmi3Float64 stopTime) {
    Component *c = core_of(instance);
    (void)toleranceDefined, (void)tolerance;
    return status(c && component_enter_initialization(c, startTime, stopTimeDefined, stopTimeDefined ? stopTime : 0));
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) {
    Component *c = core_of(instance);
    return status(c && component_exit_initialization(c));
}

fmi3Status fmi3Terminate(fmi3Instance instance) {
    Component *c = core_of(instance);
    return status(c && component_terminate(c));
}

fmi3Status fmi3Reset(fmi3Instance instance) {
    Component *c = core_of(instance);
    return status(c && component_reset(c));
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 currentCommunicationPoint, fmi3Float64 communicationStepSize,
                      fmi3Boolean noSetFMUStatePriorToCurrentPoint, fmi3Boolean *eventHandlingNeeded,
                      fmi3Boolean *terminateSimulation, fmi3Boolean *earlyReturn, fmi3Float64 *lastSuccessfulTime) {
    Component *c = core_of(instance);
    int ok;
    (void)noSetFMUStatePriorToCurrentPoint;
    if (!c) return fmi3Error;
    ok = component_step(c, currentCommunicationPoint, communicationStepSize);
    if (eventHandlingNeeded) *eventHandlingNeeded = fmi3False;
    if (terminateSimulation) *terminateSimulation = fmi3False;
    if (earlyReturn) *earlyReturn = fmi3False;
    if (lastSuccessfulTime) *lastSuccessfulTime = c->tissue->state.time;
    return status(ok);
}

/* Reads variables one after the other; fails before it has written anything if they do not fit. */
static fmi3Status get(Component *c, Type type, size_t size, const fmi3ValueReference *vr, size_t n, char *values, size_t room) {
    Slot slot;
    size_t used = 0;
    if (!c || (n && (!vr || !values))) return fmi3Error;
    for (size_t i = 0; i < n; i++) {
        if (!component_find(c, vr[i], type, 0, &slot)) return fmi3Error;
        used += slot.count;
    }
    if (used != room) {
        component_say(c, "these variables have %lu values, but there is room for %lu", (unsigned long)used, (unsigned long)room);
        return fmi3Error;
    }
    for (size_t i = 0; i < n; i++) {
        component_find(c, vr[i], type, 0, &slot);
        component_read(c, &slot, values);
        values += slot.count * size;
    }
    return fmi3OK;
}

/* Sets variables one after the other, or none of them if one value is refused. */
static fmi3Status set(Component *c, Type type, size_t size, const fmi3ValueReference *vr, size_t n, const char *values, size_t given) {
    Slot slot;
    size_t used = 0;
    if (!c || (n && (!vr || !values))) return fmi3Error;
    for (size_t i = 0; i < n; i++) {
        if (!component_find(c, vr[i], type, 0, &slot)) return fmi3Error;
        if (used + slot.count <= given && !component_check(c, &slot, values + used * size)) return fmi3Error;
        used += slot.count;
    }
    if (n && used != given) {
        component_say(c, "%lu values were given, which do not fit these variables", (unsigned long)given);
        return fmi3Error;
    }
    for (size_t i = 0; i < n; i++) {
        component_find(c, vr[i], type, 0, &slot);
        component_write(c, &slot, values);
        values += slot.count * size;
    }
    return fmi3OK;
}

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                          fmi3Float64 values[], size_t nValues) {
    return get(core_of(instance), TYPE_REAL, sizeof *values, valueReferences, nValueReferences, (char *)values, nValues);
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                          const fmi3Float64 values[], size_t nValues) {
    return set(core_of(instance), TYPE_REAL, sizeof *values, valueReferences, nValueReferences, (const char *)values, nValues);
}

fmi3Status fmi3GetInt32(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                        fmi3Int32 values[], size_t nValues) {
    return get(core_of(instance), TYPE_INTEGER, sizeof *values, valueReferences, nValueReferences, (char *)values, nValues);
}

fmi3Status fmi3SetInt32(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                        const fmi3Int32 values[], size_t nValues) {
    return set(core_of(instance), TYPE_INTEGER, sizeof *values, valueReferences, nValueReferences, (const char *)values, nValues);
}

/* Types that no variable has: only an empty list can be asked for. */
#define NO_VARIABLES(name, type)                                                                                           \
    fmi3Status fmi3Get##name(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,    \
                             type values[], size_t nValues) {                                                              \
        (void)valueReferences, (void)values;                                                                               \
        return nValueReferences || nValues ? refuse(instance, "a variable of type " #name) : status(instance != NULL);      \
    }                                                                                                                      \
    fmi3Status fmi3Set##name(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,    \
                             const type values[], size_t nValues) {                                                        \
        (void)valueReferences, (void)values;                                                                               \
        return nValueReferences || nValues ? refuse(instance, "a variable of type " #name) : status(instance != NULL);      \
    }

NO_VARIABLES(Float32, fmi3Float32)
NO_VARIABLES(Int8, fmi3Int8)
NO_VARIABLES(UInt8, fmi3UInt8)
NO_VARIABLES(Int16, fmi3Int16)
NO_VARIABLES(UInt16, fmi3UInt16)
NO_VARIABLES(UInt32, fmi3UInt32)
NO_VARIABLES(Int64, fmi3Int64)
NO_VARIABLES(UInt64, fmi3UInt64)
NO_VARIABLES(Boolean, fmi3Boolean)
NO_VARIABLES(String, fmi3String)

fmi3Status fmi3GetBinary(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                         size_t valueSizes[], fmi3Binary values[], size_t nValues) {
    (void)valueReferences, (void)valueSizes, (void)values;
    return nValueReferences || nValues ? refuse(instance, "a variable of type Binary") : status(instance != NULL);
}

fmi3Status fmi3SetBinary(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                         const size_t valueSizes[], const fmi3Binary values[], size_t nValues) {
    (void)valueReferences, (void)valueSizes, (void)values;
    return nValueReferences || nValues ? refuse(instance, "a variable of type Binary") : status(instance != NULL);
}

fmi3Status fmi3GetClock(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                        fmi3Clock values[]) {
    (void)valueReferences, (void)values;
    return nValueReferences ? refuse(instance, "a clock") : status(instance != NULL);
}

fmi3Status fmi3SetClock(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                        const fmi3Clock values[]) {
    (void)valueReferences, (void)values;
    return nValueReferences ? refuse(instance, "a clock") : status(instance != NULL);
}

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *FMUState) {
    Component *c = core_of(instance);
    if (!c || !FMUState) return fmi3Error;
    if (!*FMUState) *FMUState = malloc(component_snapshot_size(c));
    if (!*FMUState) return refuse(instance, "saving the state without memory");
    component_save(c, *FMUState);
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState FMUState) {
    Component *c = core_of(instance);
    return status(c && FMUState && component_load(c, FMUState, component_snapshot_size(c)));
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *FMUState) {
    if (!core_of(instance)) return fmi3Error;
    if (FMUState) {
        free(*FMUState);
        *FMUState = NULL;
    }
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState FMUState, size_t *size) {
    const Component *c = core_of(instance);
    if (!c || !FMUState || !size) return fmi3Error;
    *size = component_snapshot_size(c);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState FMUState, fmi3Byte serializedState[], size_t size) {
    const Component *c = core_of(instance);
    if (!c || !FMUState || !serializedState || size < component_snapshot_size(c)) return refuse(instance, "so small a buffer");
    memcpy(serializedState, FMUState, component_snapshot_size(c));
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte serializedState[], size_t size, fmi3FMUState *FMUState) {
    const Component *c = core_of(instance);
    if (!c || !serializedState || !FMUState) return fmi3Error;
    if (size != component_snapshot_size(c)) return refuse(instance, "a serialized state of another size");
    if (!*FMUState) *FMUState = malloc(size);
    if (!*FMUState) return refuse(instance, "restoring the state without memory");
    memcpy(*FMUState, serializedState, size);
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance instance, fmi3ValueReference valueReference, size_t *nDependencies) {
    (void)valueReference, (void)nDependencies;
    return refuse(instance, "asking for dependencies");
}

fmi3Status fmi3GetVariableDependencies(fmi3Instance instance, fmi3ValueReference dependent, size_t elementIndicesOfDependent[],
                                       fmi3ValueReference independents[], size_t elementIndicesOfIndependents[],
                                       fmi3DependencyKind dependencyKinds[], size_t nDependencies) {
    (void)dependent, (void)elementIndicesOfDependent, (void)independents, (void)elementIndicesOfIndependents;
    (void)dependencyKinds, (void)nDependencies;
    return refuse(instance, "asking for dependencies");
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[], size_t nUnknowns,
                                        const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,
                                        fmi3Float64 sensitivity[], size_t nSensitivity) {
    Component *c = core_of(instance);
    const Derivative derivative = {0, unknowns, knowns, nUnknowns, nKnowns, seed, nSeed, sensitivity, nSensitivity};
    if ((nUnknowns && (!unknowns || !sensitivity)) || (nKnowns && (!knowns || !seed))) return fmi3Error;
    return status(c && exchange_derive(c, &derivative));
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[], size_t nUnknowns,
                                    const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,
                                    fmi3Float64 sensitivity[], size_t nSensitivity) {
    (void)unknowns, (void)nUnknowns, (void)knowns, (void)nKnowns, (void)seed, (void)nSeed, (void)sensitivity, (void)nSensitivity;
    return refuse(instance, "an adjoint derivative");
}

fmi3Status fmi3GetOutputDerivatives(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                                    const fmi3Int32 orders[], fmi3Float64 values[], size_t nValues) {
    (void)valueReferences, (void)orders, (void)values;
    return nValueReferences || nValues ? refuse(instance, "an output derivative") : status(instance != NULL);
}

fmi3Status fmi3EnterConfigurationMode(fmi3Instance instance) { return refuse(instance, "configuration mode"); }

fmi3Status fmi3ExitConfigurationMode(fmi3Instance instance) { return refuse(instance, "configuration mode"); }

fmi3Status fmi3EnterEventMode(fmi3Instance instance) {
    Component *c = core_of(instance);
    return status(c && exchange_enter(c, PHASE_EVENT));
}

fmi3Status fmi3EnterStepMode(fmi3Instance instance) { return refuse(instance, "event mode"); }

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance instance) {
    Component *c = core_of(instance);
    return status(c && exchange_ready(c, "evaluating discrete states"));
}

/* There are none, and no events: contact is continuous. */
fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *discreteStatesNeedUpdate, fmi3Boolean *terminateSimulation,
                                    fmi3Boolean *nominalsOfContinuousStatesChanged, fmi3Boolean *valuesOfContinuousStatesChanged,
                                    fmi3Boolean *nextEventTimeDefined, fmi3Float64 *nextEventTime) {
    Component *c = core_of(instance);
    if (!c || !exchange_ready(c, "updating discrete states")) return fmi3Error;
    if (discreteStatesNeedUpdate) *discreteStatesNeedUpdate = fmi3False;
    if (terminateSimulation) *terminateSimulation = fmi3False;
    if (nominalsOfContinuousStatesChanged) *nominalsOfContinuousStatesChanged = fmi3False;
    if (valuesOfContinuousStatesChanged) *valuesOfContinuousStatesChanged = fmi3False;
    if (nextEventTimeDefined) *nextEventTimeDefined = fmi3False;
    if (nextEventTime) *nextEventTime = 0;
    return fmi3OK;
}

fmi3Status fmi3GetIntervalDecimal(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                                  fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[]) {
    (void)valueReferences, (void)nValueReferences, (void)intervals, (void)qualifiers;
    return refuse(instance, "a clock");
}

fmi3Status fmi3GetIntervalFraction(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                                   fmi3UInt64 counters[], fmi3UInt64 resolutions[], fmi3IntervalQualifier qualifiers[]) {
    (void)valueReferences, (void)nValueReferences, (void)counters, (void)resolutions, (void)qualifiers;
    return refuse(instance, "a clock");
}

fmi3Status fmi3GetShiftDecimal(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                               fmi3Float64 shifts[]) {
    (void)valueReferences, (void)nValueReferences, (void)shifts;
    return refuse(instance, "a clock");
}

fmi3Status fmi3GetShiftFraction(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                                fmi3UInt64 counters[], fmi3UInt64 resolutions[]) {
    (void)valueReferences, (void)nValueReferences, (void)counters, (void)resolutions;
    return refuse(instance, "a clock");
}

fmi3Status fmi3SetIntervalDecimal(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                                  const fmi3Float64 intervals[]) {
    (void)valueReferences, (void)nValueReferences, (void)intervals;
    return refuse(instance, "a clock");
}

fmi3Status fmi3SetIntervalFraction(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                                   const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]) {
    (void)valueReferences, (void)nValueReferences, (void)counters, (void)resolutions;
    return refuse(instance, "a clock");
}

fmi3Status fmi3SetShiftDecimal(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                               const fmi3Float64 shifts[]) {
    (void)valueReferences, (void)nValueReferences, (void)shifts;
    return refuse(instance, "a clock");
}

fmi3Status fmi3SetShiftFraction(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                                const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]) {
    (void)valueReferences, (void)nValueReferences, (void)counters, (void)resolutions;
    return refuse(instance, "a clock");
}

/* Model exchange. */

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance instance) {
    Component *c = core_of(instance);
    return status(c && exchange_enter(c, PHASE_CONTINUOUS));
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance instance, fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                                       fmi3Boolean *enterEventMode, fmi3Boolean *terminateSimulation) {
    Component *c = core_of(instance);
    (void)noSetFMUStatePriorToCurrentPoint;
    if (!c || !exchange_ready(c, "a completed integrator step")) return fmi3Error;
    if (enterEventMode) *enterEventMode = fmi3False;
    if (terminateSimulation) *terminateSimulation = fmi3False;
    return fmi3OK;
}

fmi3Status fmi3SetTime(fmi3Instance instance, fmi3Float64 time) {
    Component *c = core_of(instance);
    return status(c && exchange_time(c, time));
}

fmi3Status fmi3SetContinuousStates(fmi3Instance instance, const fmi3Float64 continuousStates[], size_t nContinuousStates) {
    Component *c = core_of(instance);
    return status(c && continuousStates && exchange_set_states(c, continuousStates, nContinuousStates));
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance instance, fmi3Float64 derivatives[], size_t nContinuousStates) {
    Component *c = core_of(instance);
    return status(c && derivatives && exchange_rates(c, derivatives, nContinuousStates));
}

fmi3Status fmi3GetEventIndicators(fmi3Instance instance, fmi3Float64 eventIndicators[], size_t nEventIndicators) {
    (void)eventIndicators;
    return nEventIndicators ? refuse(instance, "an event indicator") : status(core_of(instance) != NULL);
}

fmi3Status fmi3GetContinuousStates(fmi3Instance instance, fmi3Float64 continuousStates[], size_t nContinuousStates) {
    Component *c = core_of(instance);
    return status(c && continuousStates && exchange_get_states(c, continuousStates, nContinuousStates));
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance instance, fmi3Float64 nominals[], size_t nContinuousStates) {
    Component *c = core_of(instance);
    return status(c && nominals && exchange_nominals(c, nominals, nContinuousStates));
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *nEventIndicators) {
    if (!core_of(instance) || !nEventIndicators) return fmi3Error;
    *nEventIndicators = 0;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *nContinuousStates) {
    const Component *c = core_of(instance);
    if (!c || !nContinuousStates) return fmi3Error;
    *nContinuousStates = flow_states(c->phantom);
    return fmi3OK;
}

/* Scheduled execution: importers look for the function even where the description has none. */
fmi3Status fmi3ActivateModelPartition(fmi3Instance instance, fmi3ValueReference clockReference, fmi3Float64 activationTime) {
    (void)clockReference, (void)activationTime;
    return refuse(instance, "scheduled execution");
}
