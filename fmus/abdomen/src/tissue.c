#include "tissue.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "breath.h"
#include "wall.h"

#define REACH_M 0.030 /* least depth of the centre below the rest surface at which contact candidates are still complete */

Tissue *tissue_new(const Phantom *phantom, const Matrices *matrices) {
    const size_t n = (size_t)phantom->n;
    Tissue *t = calloc(1, sizeof *t);
    if (!t) return NULL;
    t->phantom = phantom;
    t->matrices = matrices;
    t->field = calloc((1 + BRANCHES) * n, sizeof(double));
    t->strain = calloc(n, sizeof(double));
    if (!candidates_new(&t->near, n) || !t->field || !t->strain) {
        tissue_free(t);
        return NULL;
    }
    return t;
}

void tissue_free(Tissue *t) {
    if (!t) return;
    free(t->field);
    free(t->strain);
    candidates_free(&t->near);
    free(t);
}

void tissue_reset(Tissue *t, double time) {
    memset(t->state.stretch, 0, sizeof t->state.stretch);
    t->state.activation = 1;
    memset(t->field, 0, (1 + BRANCHES) * (size_t)t->phantom->n * sizeof(double));
    tissue_begin(t, time);
}

void tissue_begin(Tissue *t, double time) {
    const size_t values = (1 + BRANCHES) * (size_t)t->phantom->n;
    const State before = t->state;
    memset(&t->state, 0, sizeof t->state);
    memcpy(t->state.stretch, before.stretch, sizeof before.stretch);
    t->state.activation = before.activation;
    t->near.count = 0;
    t->state.time = time;
    t->state.excursion = tissue_excursion(t, time);
    for (size_t i = 0; i < values && !t->state.disturbed; i++) t->state.disturbed = t->field[i] != 0;
}

double tissue_excursion(const Tissue *t, double time) {
    return t->parameters.breathing * breath_excursion(t->phantom, time + t->parameters.breathing_offset);
}

double tissue_excursion_rate(const Tissue *t, double time) {
    return t->parameters.breathing * breath_rate(t->phantom, time + t->parameters.breathing_offset);
}

double tissue_largest_excursion(const Tissue *t) { return t->parameters.breathing * breath_largest(t->phantom); }

double tissue_stiffening(const Tissue *t, int32_t i) {
    const Matrices *m = t->matrices;
    const double u = t->field[i];
    return wall_stress(u, m->stiffening[i], m->straight[i]) + t->state.activation * m->tension[i] * wall_pressed(u);
}

double tissue_stiffening_along(const Tissue *t, int32_t i, double du, double dactivation) {
    const Matrices *m = t->matrices;
    const double u = t->field[i], slope = wall_slope(u, m->stiffening[i], m->straight[i]);
    return u > 0 ? (slope + t->state.activation * m->tension[i]) * du + m->tension[i] * u * dactivation : 0;
}

Press tissue_press(const Tissue *t, const Inputs *in, int32_t i) {
    const double *n = t->phantom->normals + 3 * i, *v = in->velocity;
    const Press press = {t->field[i], -(v[0] * n[0] + v[1] * n[1] + v[2] * n[2])};
    return press;
}

double tissue_inward(const Tissue *t, int32_t i) {
    return t->state.excursion != 0 ? t->field[i] - t->state.excursion * t->phantom->breathing[i] : t->field[i];
}

static void collect(Tissue *t) {
    candidates_collect(&t->near, t->phantom, t->matrices, t->state.origin, t->state.near_radius, t->state.ball);
}

static void gather(Tissue *t, const double *p) {
    State *s = &t->state;
    double deepest = 0, least = HUGE_VAL, depth;
    for (int32_t k = 0; k < t->near.count; k++) {
        if (t->field[t->near.index[k]] > deepest) deepest = t->field[t->near.index[k]];
    }
    for (int32_t i = 0; i < t->phantom->n; i++) {
        if (!t->phantom->fixed[i]) {
            const double d = contact_distance(p, t->phantom->vertices + 3 * i);
            if (d < least) least = d;
        }
    }
    depth = deepest + 0.01 > REACH_M ? deepest + 0.01 : REACH_M;
    memcpy(s->origin, p, sizeof s->origin);
    s->near_radius = t->parameters.radius;
    s->ball = sqrt(s->near_radius * s->near_radius + depth * depth) + tissue_largest_excursion(t) + SKIN_M;
    s->reach = least - s->ball > SKIN_M ? least - s->ball : SKIN_M;
    collect(t);
}

void tissue_restore(Tissue *t) {
    if (t->state.near_radius > 0) collect(t);
    else t->near.count = 0;
}

void tissue_strain(const Tissue *t, double *strain) {
    const int32_t n = t->phantom->n;
    memcpy(strain, t->field, (size_t)n * sizeof(double));
    for (int k = 0; k < BRANCHES; k++) {
        const double *y = t->field + (size_t)(k + 1) * (size_t)n;
        if (t->parameters.prony_g[k] <= 0) continue;
        for (int32_t i = 0; i < n; i++) strain[i] -= y[i];
    }
}

/* The field as it moves by itself: u += -h C^-1 [K (u - sum y) + k_w A (sigma + tension a u)]. */
static void relax(Tissue *t, double h) {
    const Matrices *m = t->matrices;
    const double by_stiffening = h / t->parameters.dashpot;
    double *u = t->field, *strain = t->strain;
    if (!t->state.disturbed) return;
    tissue_strain(t, strain);
    if (m->stiffens) {
        for (int32_t i = 0; i < t->phantom->n; i++) u[i] -= by_stiffening * tissue_stiffening(t, i);
    }
    for (int32_t i = 0; i < t->phantom->n; i++) u[i] -= h * matrices_row(m, m->relative, strain, i);
}

/* The Prony branches: exact for a displacement that is held over the step. */
static void remember(Tissue *t, double h) {
    const int32_t n = t->phantom->n;
    if (!t->state.disturbed) return;
    for (int k = 0; k < BRANCHES; k++) {
        const double g = t->parameters.prony_g[k], decay = exp(-h / t->parameters.prony_tau[k]), feed = g * (1 - decay);
        const double *u = t->field;
        double *y = t->field + (size_t)(k + 1) * (size_t)n;
        if (g <= 0) continue;
        for (int32_t i = 0; i < n; i++) y[i] = decay * y[i] + feed * u[i];
    }
}

/* Coulomb friction by a bristle: adds force and torque on the sphere. `r` is the contact's place from the centre. */
static void rub(Tissue *t, double h, const Inputs *in, const double *r, const double *push, double *force, double *torque) {
    const double load = sqrt(push[0] * push[0] + push[1] * push[1] + push[2] * push[2]);
    const double limit = t->parameters.friction * load, stiffness = contact_skin_stiffness(t->phantom, &t->parameters);
    double *s = t->state.stretch, v[3];
    if (limit <= 0) {
        s[0] = s[1] = s[2] = 0;
        return;
    }
    contact_slip(in, r, v);
    for (int k = 0; k < 3; k++) s[k] += v[k] * h;
    contact_stick(push, limit, stiffness, s);
    contact_pull(stiffness, s, r, force, torque);
}

/* Holds the vertices under a sphere at `p` on it, and adds what that takes to force and torque. */
static void touch(Tissue *t, double h, const double *p, const Inputs *in, double *force, double *torque) {
    const Candidates *near = &t->near;
    Grip grip = {0, {0, 0, 0}, {0, 0, 0}, {0, 0, 0}, 0};
    Hold hold;
    t->deepest = -1;
    for (int32_t k = 0; k < near->count; k++) {
        const int32_t i = near->index[k];
        double gap;
        if (!contact_hold(near, k, p, t->parameters.radius, &hold)) continue;
        gap = hold.hold + t->state.excursion * near->breathing[k] - t->field[i];
        if (gap <= 0) continue;
        t->field[i] += gap;
        if (t->deepest < 0 || t->field[i] > t->field[t->deepest]) t->deepest = i;
        contact_add(&grip, near->normals + 3 * k, &hold, gap * (near->damping[k] / h));
    }
    t->state.contacts = grip.count;
    t->state.touching = grip.count > 0;
    if (!grip.count) {
        t->state.stretch[0] = t->state.stretch[1] = t->state.stretch[2] = 0;
        return;
    }
    t->state.disturbed = 1;
    for (int k = 0; k < 3; k++) {
        force[k] += grip.push[k] + grip.side[k];
        grip.point[k] /= grip.load;
    }
    rub(t, h, in, grip.point, grip.push, force, torque);
}

void tissue_step(Tissue *t, const Inputs *in, double dt, long periods, long substeps) {
    State *s = &t->state;
    const long count = periods * substeps;
    const double begin = s->time, h = dt / (double)count;
    double from[3], force[3] = {0, 0, 0}, torque[3] = {0, 0, 0};
    memcpy(from, s->moved ? s->at : in->position, sizeof from);
    for (long k = 1; k <= count; k++) {
        const double share = (double)k / (double)count;
        double p[3];
        for (int j = 0; j < 3; j++) p[j] = k == count ? in->position[j] : from[j] + share * (in->position[j] - from[j]);
        s->excursion = tissue_excursion(t, begin + dt * share);
        if (s->near_radius != t->parameters.radius || contact_distance(p, s->origin) > s->reach) gather(t, p);
        relax(t, h);
        touch(t, h, p, in, force, torque);
        remember(t, h);
        if (t->parameters.voluntary && t->deepest >= 0 && k % substeps == 0) {
            s->activation = guarding_after(s->activation, tissue_press(t, in, t->deepest), dt / (double)periods);
        }
    }
    for (int j = 0; j < 3; j++) {
        s->force[j] = force[j] / (double)count;
        s->torque[j] = torque[j] / (double)count;
        s->at[j] = in->position[j];
    }
    s->moved = 1;
    s->time = begin + dt;
}

/* x' K x / 2 with x = u, or x = u - y / g of a branch. */
static double spring_energy(const Tissue *t, const double *y, double g) {
    double sum = 0;
    for (int32_t i = 0; i < t->phantom->n; i++) t->strain[i] = y ? t->field[i] - y[i] / g : t->field[i];
    for (int32_t i = 0; i < t->phantom->n; i++) sum += matrices_row(t->matrices, t->matrices->value, t->strain, i) * t->strain[i];
    return 0.5 * sum;
}

/* What the springs store that stiffen, and those of tensed muscle. */
static double stiffening_energy(const Tissue *t) {
    const Matrices *m = t->matrices;
    double sum = 0;
    for (int32_t i = 0; i < t->phantom->n; i++) {
        const double u = t->field[i], pressed = wall_pressed(u), tension = t->state.activation * m->tension[i];
        sum += m->k_w[i] * t->phantom->areas[i] *
               (wall_stored(u, m->stiffening[i], m->straight[i]) + tension * pressed * pressed / 2);
    }
    return sum;
}

double tissue_energy(const Tissue *t) {
    const double *s = t->state.stretch;
    double held = 1, stored = 0.5 * contact_skin_stiffness(t->phantom, &t->parameters) * (s[0] * s[0] + s[1] * s[1] + s[2] * s[2]);
    for (int k = 0; k < BRANCHES; k++) {
        const double g = t->parameters.prony_g[k];
        if (g <= 0) continue;
        held -= g;
        stored += g * spring_energy(t, t->field + (size_t)(k + 1) * (size_t)t->phantom->n, g);
    }
    return stored + held * spring_energy(t, NULL, 1) + stiffening_energy(t);
}
