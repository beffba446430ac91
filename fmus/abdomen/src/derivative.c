/* Directional derivatives: a shadow of the component holds the direction where that holds inputs and states, and after `derive`
 * the change where that holds outputs and rates. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "exchange.h"

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

/* The shadow, all zero; NULL if there is no memory. */
static Component *shadow_of(Component *c) {
    const size_t n = (size_t)c->phantom->n, states = flow_states(c->phantom), samples = (size_t)c->phantom->samples;
    const size_t total = 2 * states + n + samples;
    Arrays *a;
    if (!c->shadow_memory) c->shadow_memory = calloc(total, sizeof(double));
    if (!c->shadow) c->shadow = calloc(1, sizeof *c->shadow);
    if (!c->shadow_memory || !c->shadow) return NULL;
    memset(c->shadow, 0, sizeof *c->shadow);
    memset(c->shadow_memory, 0, total * sizeof(double));
    a = &c->shadow->arrays;
    a->displacement = c->shadow_memory;
    a->relaxation = a->displacement + n;
    a->stretch = a->displacement + states - 4;
    a->activation = a->stretch + 3;
    a->displacement_rate = a->displacement + states;
    a->relaxation_rate = a->displacement_rate + n;
    a->stretch_rate = a->displacement_rate + states - 4;
    a->activation_rate = a->stretch_rate + 3;
    a->inward = a->displacement_rate + states;
    a->sample_inward = a->inward + n;
    return c->shadow;
}

/* Of indentation, rest point and the parts of the force. */
static void look_under_along(const Component *c, Component *s) {
    const Outputs *o = &c->outputs;
    Outputs *d = &s->outputs;
    const double excursion = c->tissue->state.excursion, *n = o->normal;
    const RestPoint change =
        surface_nearest_along(c->surface, c->inputs.position, excursion, c->matrices->k_w, s->inputs.position, d->excursion);
    const double along = dot(o->force, n), dalong = dot(d->force, n) + dot(o->force, change.normal);
    double inner = 0;
    memcpy(d->point, change.position, sizeof d->point);
    memcpy(d->normal, change.normal, sizeof d->normal);
    d->depth = -change.height;
    d->k_w = change.k_w;
    d->normal_force = along > 0 ? dalong : 0;
    for (int k = 0; k < 3; k++) {
        inner += (o->force[k] - along * n[k]) * (d->force[k] - dalong * n[k] - along * change.normal[k]);
    }
    d->tangential_force = o->tangential_force > 0 ? inner / o->tangential_force : 0;
}

/* Of the energy stored in springs: sum of x' K dx, with x = u, or x = u - y / g of a branch; and of those that stiffen. */
static double energy_along(const Component *c, const Component *s) {
    const int32_t n = c->phantom->n;
    const double *u = c->arrays.displacement, *du = s->arrays.displacement;
    double *x = c->tissue->strain, held = 1, change = 0;
    for (int32_t k = 0; k <= c->phantom->branches; k++) {
        const int last = k == c->phantom->branches;
        const double g = last ? held : c->parameters.prony_g[k];
        const double *y = c->arrays.relaxation + (size_t)k * (size_t)n, *dy = s->arrays.relaxation + (size_t)k * (size_t)n;
        double sum = 0;
        if (g <= 0) continue;
        if (!last) held -= g;
        for (int32_t i = 0; i < n; i++) x[i] = last ? u[i] : u[i] - y[i] / g;
        for (int32_t i = 0; i < n; i++) {
            sum += matrices_row(c->matrices, c->matrices->value, x, i) * (last ? du[i] : du[i] - dy[i] / g);
        }
        change += g * sum;
    }
    for (int32_t i = 0; i < n; i++) {
        const double by_muscle = u[i] > 0 ? c->matrices->tension[i] * u[i] * u[i] / 2 * s->arrays.activation[0] : 0;
        change += c->matrices->k_w[i] * c->phantom->areas[i] * (tissue_stiffening(c->tissue, i) * du[i] + by_muscle);
    }
    return change + contact_skin_stiffness(c->phantom, &c->parameters) * dot(c->arrays.stretch, s->arrays.stretch);
}

static void derive(Component *c, Component *s) {
    Direction along;
    Change change;
    component_refresh(c, GROUP_UNDER); /* with it the rates, of which these are the derivatives */
    memset(&along, 0, sizeof along);
    along.time = s->outputs.time;
    along.inputs = s->inputs;
    along.field = s->arrays.displacement;
    memcpy(along.stretch, s->arrays.stretch, sizeof along.stretch);
    along.activation = s->arrays.activation[0];
    change.rate = s->arrays.displacement_rate;
    flow_derive(c->flow, &c->inputs, &along, &change);
    s->outputs.excursion = change.excursion;
    memcpy(s->outputs.force, change.force, sizeof change.force);
    memcpy(s->outputs.torque, change.torque, sizeof change.torque);
    look_under_along(c, s);
    s->outputs.energy = energy_along(c, s);
    for (int32_t i = 0; i < c->phantom->n; i++) {
        s->arrays.inward[i] = s->arrays.displacement[i] - change.excursion * c->phantom->breathing[i];
    }
    for (int32_t i = 0; i < c->phantom->samples; i++) s->arrays.sample_inward[i] = s->arrays.inward[c->phantom->sample[i]];
}

static int is_known(const Row *row) {
    return row->access == ACCESS_INPUT || row->access == ACCESS_STATE || row->offset == offsetof(Component, outputs.time);
}

static int is_unknown(const Row *row) {
    if (row->access != ACCESS_READ || row->type != TYPE_REAL) return 0;
    return row->group == GROUP_RATES || row->group == GROUP_STATE || row->group == GROUP_UNDER || row->group == GROUP_ENERGY ||
           row->group == GROUP_INWARD;
}

/* Whether all of the variables can be what they are asked for, and have `size` values together. */
static int suits(Component *c, int flat, const uint32_t *references, size_t count, size_t size, int (*accepts)(const Row *),
                 const char *what) {
    Slot slot;
    size_t used = 0;
    for (size_t i = 0; i < count; i++) {
        if (!component_find(c, references[i], TYPE_REAL, flat, &slot)) return 0;
        if (!accepts(slot.row)) {
            component_say(c, "%s cannot be %s of a directional derivative", slot.row->name, what);
            return 0;
        }
        used += slot.count;
    }
    if (used != size) {
        component_say(c, "%s of the directional derivative have %lu values, not %lu", what, (unsigned long)used, (unsigned long)size);
        return 0;
    }
    return 1;
}

int exchange_derive(Component *c, const Derivative *d) {
    Component *shadow;
    Slot slot;
    size_t used = 0;
    if (!exchange_ready(c, "a directional derivative")) return 0;
    if (!suits(c, d->flat, d->unknowns, d->unknown_count, d->sensitivity_size, is_unknown, "unknowns")) return 0;
    if (!suits(c, d->flat, d->knowns, d->known_count, d->seed_size, is_known, "knowns")) return 0;
    shadow = shadow_of(c);
    if (!shadow) {
        component_say(c, "out of memory for a directional derivative");
        return 0;
    }
    for (size_t i = 0; i < d->known_count; i++, used += slot.count) {
        component_find(c, d->knowns[i], TYPE_REAL, d->flat, &slot);
        memcpy(component_data(shadow, slot.row) + slot.first * sizeof(double), d->seed + used, slot.count * sizeof(double));
    }
    derive(c, shadow);
    used = 0;
    for (size_t i = 0; i < d->unknown_count; i++, used += slot.count) {
        component_find(c, d->unknowns[i], TYPE_REAL, d->flat, &slot);
        memcpy(d->sensitivity + used, component_data(shadow, slot.row) + slot.first * sizeof(double), slot.count * sizeof(double));
    }
    return 1;
}
