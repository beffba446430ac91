/* What variables show: computed when they are read, and kept until something changes. */
#include <math.h>
#include <string.h>

#include "component.h"

void component_assemble(Component *c) {
    if (!c->stale_matrices) return;
    matrices_assemble(c->matrices, c->phantom, &c->parameters);
    flow_forget(c->flow);
    c->stale_matrices = 0;
}

/* The wrench's share along the surface normal and across it; the indentation at the rest point beneath. */
static void look_under(Component *c) {
    const State *s = &c->tissue->state;
    const double *p = s->moved ? s->at : c->inputs.position;
    Outputs *o = &c->outputs;
    RestPoint under;
    double across = 0, along = 0;
    component_assemble(c);
    component_refresh(c, GROUP_STATE);
    under = surface_nearest(c->surface, p, s->excursion, c->matrices->k_w);
    for (int k = 0; k < 3; k++) {
        o->point[k] = under.position[k];
        o->normal[k] = under.normal[k];
        along += o->force[k] * under.normal[k];
    }
    for (int k = 0; k < 3; k++) {
        const double part = o->force[k] - along * under.normal[k];
        across += part * part;
    }
    o->depth = c->parameters.radius - under.height;
    o->k_w = under.k_w;
    o->normal_force = along > 0 ? along : 0;
    o->tangential_force = sqrt(across);
}

static void displace(Component *c) {
    for (int32_t i = 0; i < c->phantom->n; i++) c->arrays.inward[i] = tissue_inward(c->tissue, i);
    for (int32_t i = 0; i < c->phantom->samples; i++) c->arrays.sample_inward[i] = c->arrays.inward[c->phantom->sample[i]];
}

static void deform(Component *c) {
    const Phantom *p = c->phantom;
    displace(c);
    for (int32_t i = 0; i < p->n; i++) {
        for (int k = 0; k < 3; k++) {
            c->arrays.position[3 * i + k] = p->vertices[3 * i + k] - c->arrays.inward[i] * p->normals[3 * i + k];
        }
    }
    surface_normals(c->surface, c->arrays.inward, c->arrays.normal);
}

void component_refresh(Component *c, Group group) {
    const State *s = &c->tissue->state;
    if (group == GROUP_NONE || c->fresh & 1u << group) return;
    switch (group) {
        case GROUP_MATRICES: component_assemble(c); break;
        case GROUP_RATES:
            component_assemble(c);
            flow_evaluate(c->flow, &c->inputs);
            break;
        case GROUP_STATE:
            if (c->exchange) component_refresh(c, GROUP_RATES);
            memcpy(c->outputs.force, c->exchange ? c->flow->force : s->force, sizeof s->force);
            memcpy(c->outputs.torque, c->exchange ? c->flow->torque : s->torque, sizeof s->torque);
            c->outputs.contacts = c->exchange ? c->flow->grip.count : s->contacts;
            c->outputs.excursion = s->excursion;
            c->outputs.time = s->time;
            break;
        case GROUP_UNDER: look_under(c); break;
        case GROUP_ENERGY:
            component_assemble(c);
            c->outputs.energy = tissue_energy(c->tissue);
            break;
        case GROUP_INWARD: displace(c); break;
        case GROUP_SHAPE: deform(c); break;
        default: break;
    }
    c->fresh |= 1u << group;
}
