#include "exchange.h"

#include <math.h>
#include <string.h>

#define NOMINAL_M 1e-3 /* of a state that is a length: what an integrator's tolerance is relative to */
#define LARGEST 2.0    /* of a state, in its own unit: integrators try values a little out of place */

static int is_running(const Component *c) { return c->phase == PHASE_EVENT || c->phase == PHASE_CONTINUOUS; }

static int is_initialised(const Component *c) { return is_running(c) || (c->exchange && c->phase == PHASE_INITIALIZATION); }

int exchange_ready(Component *c, const char *function) { return component_expects(c, is_running(c), function); }

int exchange_enter(Component *c, Phase phase) {
    if (!exchange_ready(c, phase == PHASE_EVENT ? "event mode" : "continuous-time mode")) return 0;
    c->phase = phase;
    return 1;
}

int exchange_time(Component *c, double time) {
    if (!exchange_ready(c, "setting the time")) return 0;
    if (!isfinite(time)) {
        component_say(c, "a time of %g s is not possible", time);
        return 0;
    }
    c->tissue->state.time = time;
    c->tissue->state.excursion = tissue_excursion(c->tissue, time);
    c->fresh &= 1u << GROUP_MATRICES;
    return 1;
}

/* Whether states can be read or, if `ready`, be set, and are so many. */
static int fits(Component *c, int ready, size_t count, const char *function) {
    const size_t states = flow_states(c->phantom);
    if (!component_expects(c, ready, function)) return 0;
    if (count != states) {
        component_say(c, "%s: this FMU has %lu continuous states, not %lu", function, (unsigned long)states, (unsigned long)count);
    }
    return count == states;
}

int exchange_set_states(Component *c, const double *values, size_t count) {
    if (!fits(c, is_running(c), count, "setting continuous states")) return 0;
    for (size_t i = 0; i < count; i++) {
        if (!(fabs(values[i]) <= LARGEST)) {
            component_say(c, "continuous state %lu = %g is not allowed: expected %g to %g", (unsigned long)i + 1, values[i], -LARGEST,
                          LARGEST);
            return 0;
        }
    }
    memcpy(c->tissue->field, values, (count - 4) * sizeof *values);
    memcpy(c->tissue->state.stretch, values + count - 4, 3 * sizeof *values);
    c->tissue->state.activation = values[count - 1];
    c->fresh &= 1u << GROUP_MATRICES;
    return 1;
}

int exchange_get_states(Component *c, double *values, size_t count) {
    if (!fits(c, is_initialised(c), count, "getting continuous states")) return 0;
    memcpy(values, c->tissue->field, (count - 4) * sizeof *values);
    memcpy(values + count - 4, c->tissue->state.stretch, 3 * sizeof *values);
    values[count - 1] = c->tissue->state.activation;
    return 1;
}

int exchange_rates(Component *c, double *values, size_t count) {
    if (!fits(c, is_initialised(c), count, "getting the states' derivatives")) return 0;
    component_refresh(c, GROUP_RATES);
    memcpy(values, c->flow->rate, count * sizeof *values);
    return 1;
}

int exchange_nominals(Component *c, double *values, size_t count) {
    if (!fits(c, is_initialised(c), count, "getting nominal values")) return 0;
    for (size_t i = 0; i < count; i++) values[i] = i + 1 < count ? NOMINAL_M : 1;
    return 1;
}
