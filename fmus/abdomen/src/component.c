#include "component.h"

#include <math.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define LONGEST_STEP_S 60.0
#define PERIOD_S 1e-3    /* a longer step is cut, so that contact and friction are followed */
#define MOST_SUBSTEPS 64 /* of a period */
#define STEP_TOLERANCE 1e-6

static const Row ROWS[] = {
#define ROW(vr, type, access, of, count, low, high, group, member, name) \
    {vr, TYPE_##type, ACCESS_##access, COUNT_##of, count, low, high, GROUP_##group, offsetof(Component, member), name},
#include "variables.h"
#undef ROW
};
#define ROW_COUNT (sizeof ROWS / sizeof ROWS[0])

void component_say(const Component *c, const char *format, ...) {
    char message[512];
    va_list arguments;
    if (!c->log) return;
    va_start(arguments, format);
    vsnprintf(message, sizeof message, format, arguments);
    va_end(arguments);
    c->log(c->environment, message);
}

static size_t row_count(const Component *c, const Row *row) {
    const size_t each = (size_t)row->count;
    switch (row->of) {
        case COUNT_VERTICES: return each * (size_t)c->phantom->n;
        case COUNT_BRANCHES: return each * (size_t)c->phantom->branches * (size_t)c->phantom->n;
        case COUNT_TRIANGLES: return each * (size_t)c->phantom->m;
        case COUNT_SAMPLES: return each * (size_t)c->phantom->samples;
        default: return each;
    }
}

char *component_data(Component *c, const Row *row) {
    char *place = (char *)c + row->offset;
    if (row->of != COUNT_PLAIN) {
        void *array;
        memcpy(&array, place, sizeof array);
        return array;
    }
    return place;
}

static void start_values(Component *c) {
    int k = 0;
    memset(&c->inputs, 0, sizeof c->inputs);
    c->inputs.position[2] = 1; /* out of reach of the abdomen */
    for (size_t r = 0; r < ROW_COUNT; r++) {
        const Row *row = &ROWS[r];
        char *data = component_data(c, row);
        if (row->access != ACCESS_FIXED && row->access != ACCESS_TUNABLE) continue;
        for (int i = 0; i < row->count; i++, k++) {
            if (row->type == TYPE_REAL) {
                memcpy(data + (size_t)i * sizeof(double), &c->phantom->start[k], sizeof(double));
            } else {
                const int32_t value = (int32_t)c->phantom->start[k];
                memcpy(data + (size_t)i * sizeof value, &value, sizeof value);
            }
        }
    }
}

/* Whether the file has as many start values as there are, each within its bounds. */
static int start_values_fit(const Component *c) {
    int k = 0;
    for (size_t r = 0; r < ROW_COUNT; r++) {
        if (ROWS[r].access != ACCESS_FIXED && ROWS[r].access != ACCESS_TUNABLE) continue;
        for (int i = 0; i < ROWS[r].count; i++, k++) {
            if (k >= c->phantom->values) return 0;
            if (!(c->phantom->start[k] >= ROWS[r].low && c->phantom->start[k] <= ROWS[r].high)) return 0;
        }
    }
    return k == c->phantom->values;
}

static int allocate(Component *c) {
    const size_t n = (size_t)c->phantom->n, samples = (size_t)c->phantom->samples + 1;
    Arrays *a = &c->arrays;
    c->matrices = matrices_new(c->phantom);
    c->surface = surface_new(c->phantom);
    if (!c->matrices || !c->surface) return 0;
    c->tissue = tissue_new(c->phantom, c->matrices);
    if (!c->tissue) return 0;
    c->flow = flow_new(c->tissue);
    if (!c->flow) return 0;
    a->displacement = c->tissue->field;
    a->relaxation = c->tissue->field + n;
    a->stretch = c->tissue->state.stretch;
    a->displacement_rate = c->flow->rate;
    a->relaxation_rate = c->flow->rate + n;
    a->stretch_rate = c->flow->rate + flow_states(c->phantom) - 4;
    a->activation = &c->tissue->state.activation;
    a->activation_rate = a->stretch_rate + 3;
    a->inward = calloc(n, sizeof(double));
    a->position = calloc(3 * n, sizeof(double));
    a->normal = calloc(3 * n, sizeof(double));
    a->sample_inward = calloc(samples, sizeof(double));
    a->sample_position = calloc(3 * samples, sizeof(double));
    a->rest_position = c->phantom->vertices;
    a->rest_normal = c->phantom->normals;
    a->stiffness = c->matrices->k_w;
    a->background = c->matrices->plain;
    a->stiffening = c->phantom->stiffening;
    a->tension = c->phantom->tension;
    a->lesion = c->matrices->lesion;
    a->triangles = c->phantom->triangles;
    return a->inward && a->position && a->normal && a->sample_inward && a->sample_position;
}

Component *component_new(const char *resources, const char *token, int exchange, Log log, void *environment) {
    Component *c = calloc(1, sizeof *c);
    char error[400], *path;
    size_t length;
    if (!c) return NULL;
    c->exchange = exchange;
    c->log = log;
    c->environment = environment;
    length = resources ? strlen(resources) : 0;
    path = malloc(length + 16);
    if (!length || !path) {
        component_say(c, length ? "out of memory" : "no path to the FMU's resources was given");
        free(path);
        component_free(c);
        return NULL;
    }
    memcpy(path, resources, length);
    if (path[length - 1] != '/' && path[length - 1] != '\\') path[length++] = '/';
    memcpy(path + length, "phantom.bin", 12);
    c->phantom = phantom_read(path, error, sizeof error);
    free(path);
    if (!c->phantom) {
        component_say(c, "%s", error);
    } else if (!token || strcmp(token, c->phantom->token) != 0) {
        component_say(c, "the token %s is not that of this FMU, %s", token ? token : "(none)", c->phantom->token);
    } else if (!start_values_fit(c)) {
        component_say(c, "the start values in the phantom file do not fit this FMU's parameters");
    } else if (!allocate(c)) {
        component_say(c, "out of memory for %ld vertices", (long)c->phantom->n);
    } else {
        for (int32_t i = 0; i < c->phantom->samples; i++) {
            memcpy(c->arrays.sample_position + 3 * i, c->phantom->vertices + 3 * c->phantom->sample[i], 3 * sizeof(double));
        }
        component_reset(c);
        return c;
    }
    component_free(c);
    return NULL;
}

void component_free(Component *c) {
    if (!c) return;
    free(c->arrays.inward);
    free(c->arrays.position);
    free(c->arrays.normal);
    free(c->arrays.sample_inward);
    free(c->arrays.sample_position);
    free(c->shadow_memory);
    free(c->shadow);
    flow_free(c->flow);
    tissue_free(c->tissue);
    surface_free(c->surface);
    matrices_free(c->matrices);
    phantom_free(c->phantom);
    free(c);
}

int component_expects(Component *c, int phase_is_right, const char *function) {
    static const char *const NAMES[] = {"instantiated", "initialization mode",   "step mode",
                                        "event mode",   "continuous-time mode", "terminated"};
    if (!phase_is_right) component_say(c, "%s is not allowed in the state: %s", function, NAMES[c->phase]);
    return phase_is_right;
}

int component_reset(Component *c) {
    start_values(c);
    c->phase = PHASE_INSTANTIATED;
    c->has_stop = 0;
    c->stale_matrices = 1;
    c->fresh = 0;
    c->tissue->parameters = c->parameters;
    tissue_reset(c->tissue, 0);
    return 1;
}

int component_find(Component *c, uint32_t vr, Type type, int flat, Slot *slot) {
    for (size_t r = 0; r < ROW_COUNT; r++) {
        const Row *row = &ROWS[r];
        const size_t count = row_count(c, row);
        if (row->vr > vr || (flat ? vr - row->vr >= count : vr != row->vr)) continue;
        if (row->type != type) {
            component_say(c, "%s (value reference %lu) is of another type", row->name, (unsigned long)vr);
            return 0;
        }
        slot->row = row;
        slot->first = flat ? vr - row->vr : 0;
        slot->count = flat ? 1 : count;
        return 1;
    }
    component_say(c, "there is no variable with value reference %lu", (unsigned long)vr);
    return 0;
}

static size_t size_of(Type type) { return type == TYPE_REAL ? sizeof(double) : sizeof(int32_t); }

int component_read(Component *c, const Slot *slot, void *values) {
    const size_t size = size_of(slot->row->type);
    component_refresh(c, slot->row->group);
    memcpy(values, component_data(c, slot->row) + slot->first * size, slot->count * size);
    return 1;
}

int component_check(Component *c, const Slot *slot, const void *values) {
    const Row *row = slot->row;
    const int before = c->phase == PHASE_INSTANTIATED || c->phase == PHASE_INITIALIZATION;
    if (row->access == ACCESS_READ) {
        component_say(c, "%s cannot be set: it is an output", row->name);
        return 0;
    }
    if (c->phase == PHASE_TERMINATED || (row->access == ACCESS_FIXED && !before)) {
        component_say(c, "%s cannot be set any more: it is fixed after initialization", row->name);
        return 0;
    }
    if (row->access == ACCESS_STATE && !before && !c->exchange) {
        component_say(c, "%s cannot be set any more: in co-simulation it is the FMU's after initialization", row->name);
        return 0;
    }
    for (size_t i = 0; i < slot->count; i++) {
        double value;
        if (row->type == TYPE_REAL) {
            memcpy(&value, (const char *)values + i * sizeof value, sizeof value);
        } else {
            int32_t integer;
            memcpy(&integer, (const char *)values + i * sizeof integer, sizeof integer);
            value = integer;
        }
        if (!(value >= row->low && value <= row->high)) {
            component_say(c, "%s[%lu] = %g is not allowed: expected %g to %g", row->name,
                          (unsigned long)(slot->first + i + 1), value, row->low, row->high);
            return 0;
        }
    }
    return 1;
}

void component_write(Component *c, const Slot *slot, const void *values) {
    const size_t size = size_of(slot->row->type);
    char *data = component_data(c, slot->row) + slot->first * size;
    if (memcmp(data, values, slot->count * size) == 0) return;
    memcpy(data, values, slot->count * size);
    if (c->exchange || slot->row->access == ACCESS_STATE) c->fresh &= 1u << GROUP_MATRICES;
    else c->fresh &= ~(1u << GROUP_UNDER | 1u << GROUP_RATES);
    if (slot->row->access == ACCESS_FIXED) {
        c->stale_matrices = 1;
        c->fresh = 0;
    }
    if (slot->row->access == ACCESS_FIXED || slot->row->access == ACCESS_TUNABLE) c->tissue->parameters = c->parameters;
}

int component_enter_initialization(Component *c, double start, int has_stop, double stop) {
    if (!component_expects(c, c->phase == PHASE_INSTANTIATED, "entering initialization mode")) return 0;
    if (!isfinite(start) || (has_stop && !(stop >= start))) {
        component_say(c, "start time %g and stop time %g do not fit", start, stop);
        return 0;
    }
    c->has_stop = has_stop;
    c->stop = stop;
    tissue_begin(c->tissue, start);
    c->phase = PHASE_INITIALIZATION;
    c->fresh = 0;
    return 1;
}

/* In model exchange a Prony branch is a state, of which the phantom fixed the number. */
static int branches_suffice(Component *c) {
    for (int32_t k = c->phantom->branches; k < BRANCHES; k++) {
        if (c->parameters.prony_g[k] <= 0) continue;
        component_say(c, "prony_g[%ld] = %g needs a branch, but for model exchange this FMU was built with %ld", (long)k + 1,
                      c->parameters.prony_g[k], (long)c->phantom->branches);
        return 0;
    }
    return 1;
}

/* What no single bound can say. */
static int parameters_agree(Component *c) {
    double relaxing = 0, needed, contracted = c->tissue->state.activation;
    for (int k = 0; k < BRANCHES; k++) relaxing += c->parameters.prony_g[k];
    if (relaxing >= 1) {
        component_say(c, "prony_g must sum to less than 1, not %g", relaxing);
        return 0;
    }
    if (contracted < 0 || contracted > 1) {
        component_say(c, "activation must be 0 to 1 at the start, not %g", contracted);
        return 0;
    }
    component_assemble(c);
    if (!isfinite(c->matrices->rate)) {
        component_say(c, "the stiffness of this phantom is out of all bounds");
        return 0;
    }
    if (c->exchange) return branches_suffice(c);
    needed = matrices_substeps(c->matrices, PERIOD_S);
    if (needed > MOST_SUBSTEPS) {
        component_say(c, "%.0f sub-steps a millisecond would be needed, at most %d are allowed: use a shorter pasternak_length "
                         "or a larger dashpot",
                      needed, MOST_SUBSTEPS);
        return 0;
    }
    return 1;
}

int component_exit_initialization(Component *c) {
    if (!component_expects(c, c->phase == PHASE_INITIALIZATION, "leaving initialization mode")) return 0;
    if (!parameters_agree(c)) return 0;
    c->tissue->parameters = c->parameters;
    tissue_begin(c->tissue, c->tissue->state.time);
    c->phase = c->exchange ? PHASE_EVENT : PHASE_STEP;
    c->fresh &= 1u << GROUP_MATRICES;
    return 1;
}

int component_step(Component *c, double time, double dt) {
    const double now = c->tissue->state.time, periods = ceil(dt / PERIOD_S * (1 - 1e-9));
    if (!component_expects(c, c->phase == PHASE_STEP, "a step")) return 0;
    if (!(dt > 0) || dt > LONGEST_STEP_S) {
        component_say(c, "a step of %g s is not possible: expected more than 0 and at most %g s", dt, LONGEST_STEP_S);
        return 0;
    }
    if (!(fabs(time - now) <= STEP_TOLERANCE * dt + 1e-12 * fabs(now))) {
        component_say(c, "a step from %.9g s is not possible: the time reached is %.9g s, and going back needs a saved FMU state",
                      time, now);
        return 0;
    }
    if (c->has_stop && time + dt > c->stop + STEP_TOLERANCE * dt + 1e-12 * fabs(c->stop)) {
        component_say(c, "a step to %.9g s is not possible: the stop time is %.9g s", time + dt, c->stop);
        return 0;
    }
    c->tissue->state.time = time;
    tissue_step(c->tissue, &c->inputs, dt, (long)periods, (long)matrices_substeps(c->matrices, dt / periods));
    c->fresh &= 1u << GROUP_MATRICES;
    return 1;
}

int component_terminate(Component *c) {
    const int running = c->phase == PHASE_STEP || c->phase == PHASE_EVENT || c->phase == PHASE_CONTINUOUS;
    if (!component_expects(c, running, "termination")) return 0;
    c->phase = PHASE_TERMINATED;
    return 1;
}

static size_t field_size(const Component *c) { return (1 + BRANCHES) * (size_t)c->phantom->n * sizeof(double); }

size_t component_snapshot_size(const Component *c) { return sizeof(Snapshot) + field_size(c); }

void component_save(const Component *c, Snapshot *s) {
    memset(s, 0, sizeof *s);
    memcpy(s->token, c->phantom->token, sizeof c->phantom->token);
    s->parameters = c->parameters;
    s->inputs = c->inputs;
    s->state = c->tissue->state;
    s->stop = c->stop;
    s->has_stop = c->has_stop;
    s->phase = (int32_t)c->phase;
    s->exchange = c->exchange;
    memcpy(s->field, c->tissue->field, field_size(c));
}

int component_load(Component *c, const Snapshot *s, size_t size) {
    if (size != component_snapshot_size(c) || s->phase < PHASE_INSTANTIATED || s->phase > PHASE_TERMINATED ||
        s->parameters.lesion_count < 0 || s->parameters.lesion_count > LESIONS) {
        component_say(c, "this is not a state of this FMU");
        return 0;
    }
    if (memcmp(s->token, c->phantom->token, sizeof c->phantom->token) != 0) {
        component_say(c, "this is the state of an FMU of another phantom");
        return 0;
    }
    if (s->exchange != c->exchange) {
        component_say(c, "this is the state of an instance for the other of model exchange and co-simulation");
        return 0;
    }
    if (memcmp(&c->parameters, &s->parameters, sizeof c->parameters) != 0) c->stale_matrices = 1;
    c->parameters = s->parameters;
    c->inputs = s->inputs;
    c->stop = s->stop;
    c->has_stop = s->has_stop;
    c->phase = (Phase)s->phase;
    c->tissue->parameters = s->parameters;
    c->tissue->state = s->state;
    memcpy(c->tissue->field, s->field, field_size(c));
    if (c->phase >= PHASE_STEP) component_assemble(c);
    tissue_restore(c->tissue);
    c->fresh = 0;
    return 1;
}
