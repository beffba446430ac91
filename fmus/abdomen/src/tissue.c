#include "tissue.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define SKIN_M 0.0025 /* candidates are gathered anew when the sphere has moved this far */
#define REACH_M 0.030 /* least depth of the centre below the rest surface at which they are still complete */
#define RIM 0.2       /* the sphere holds vertices up to 78 degrees from its pole (cos > 0.2) */

/* Mindlin's tangential stiffness 8 a G / (2 - nu) of a sticking contact; k_w = 1.7e5 N/m^3 stands for E = 10 kPa. */
#define REFERENCE_K_W 1.7e5
#define REFERENCE_E 1.0e4
#define REFERENCE_RADIUS_M 0.012
#define POISSON 0.49

static const double PI = 3.14159265358979323846;

static double shear_stiffness(double k_w) {
    const double modulus = REFERENCE_E * k_w / REFERENCE_K_W / (2 * (1 + POISSON));
    return 8 * REFERENCE_RADIUS_M * modulus / (2 - POISSON);
}

static double skin_stiffness(const Tissue *t) {
    return shear_stiffness(t->parameters.scale * t->phantom->median_background);
}

Tissue *tissue_new(const Phantom *phantom, const Matrices *matrices) {
    const size_t n = (size_t)phantom->n;
    Tissue *t = calloc(1, sizeof *t);
    if (!t) return NULL;
    t->phantom = phantom;
    t->matrices = matrices;
    t->field = calloc((1 + BRANCHES) * n, sizeof(double));
    t->strain = calloc(n, sizeof(double));
    t->near.index = calloc(n, sizeof(int32_t));
    t->near.normals = calloc(3 * n, sizeof(double));
    t->near.positions = calloc(3 * n, sizeof(double));
    t->near.breathing = calloc(n, sizeof(double));
    t->near.damping = calloc(n, sizeof(double));
    if (!t->field || !t->strain || !t->near.index || !t->near.normals || !t->near.positions || !t->near.breathing ||
        !t->near.damping) {
        tissue_free(t);
        return NULL;
    }
    return t;
}

void tissue_free(Tissue *t) {
    if (!t) return;
    free(t->field);
    free(t->strain);
    free(t->near.index);
    free(t->near.normals);
    free(t->near.positions);
    free(t->near.breathing);
    free(t->near.damping);
    free(t);
}

void tissue_reset(Tissue *t, double time) {
    memset(&t->state, 0, sizeof t->state);
    memset(t->field, 0, (1 + BRANCHES) * (size_t)t->phantom->n * sizeof(double));
    t->near.count = 0;
    t->state.time = time;
    t->state.excursion = tissue_excursion(&t->parameters, time);
}

double tissue_excursion(const Parameters *par, double time) {
    if (par->amplitude == 0) return 0;
    return par->amplitude * sin(2 * PI * par->rate / 60 * time + par->phase);
}

double tissue_inward(const Tissue *t, int32_t i) {
    return t->state.excursion != 0 ? t->field[i] - t->state.excursion * t->phantom->breathing[i] : t->field[i];
}

static double distance(const double *a, const double *b) {
    const double x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2];
    return sqrt(x * x + y * y + z * z);
}

/* The vertices that a sphere near state->origin might hold: within state->ball, and on the side that faces it. */
static void collect(Tissue *t) {
    const Phantom *p = t->phantom;
    const State *s = &t->state;
    Candidates *near = &t->near;
    const double *facing;
    int32_t nearest = -1;
    double least = HUGE_VAL;
    for (int32_t i = 0; i < p->n; i++) {
        if (!p->fixed[i]) {
            const double d = distance(s->origin, p->vertices + 3 * i);
            if (d < least) {
                least = d;
                nearest = i;
            }
        }
    }
    near->count = 0;
    if (nearest < 0) return;
    facing = p->normals + 3 * nearest;
    for (int32_t i = 0; i < p->n; i++) {
        const double *n = p->normals + 3 * i, *at = p->vertices + 3 * i;
        double x, y, z, height;
        int32_t k;
        if (p->fixed[i] || distance(s->origin, at) > s->ball) continue;
        x = at[0] - s->origin[0], y = at[1] - s->origin[1], z = at[2] - s->origin[2];
        height = n[0] * x + n[1] * y + n[2] * z;
        x -= height * n[0], y -= height * n[1], z -= height * n[2];
        if (sqrt(x * x + y * y + z * z) >= s->near_radius + SKIN_M) continue;
        if (n[0] * facing[0] + n[1] * facing[1] + n[2] * facing[2] <= 0) continue; /* the far side of something thin */
        k = near->count++;
        near->index[k] = i;
        memcpy(near->normals + 3 * k, n, 3 * sizeof(double));
        memcpy(near->positions + 3 * k, at, 3 * sizeof(double));
        near->breathing[k] = p->breathing[i];
        near->damping[k] = t->matrices->damping[i];
    }
}

static void gather(Tissue *t, const double *p) {
    State *s = &t->state;
    double deepest = 0, least = HUGE_VAL, depth;
    for (int32_t k = 0; k < t->near.count; k++) {
        if (t->field[t->near.index[k]] > deepest) deepest = t->field[t->near.index[k]];
    }
    for (int32_t i = 0; i < t->phantom->n; i++) {
        if (!t->phantom->fixed[i]) {
            const double d = distance(p, t->phantom->vertices + 3 * i);
            if (d < least) least = d;
        }
    }
    depth = deepest + 0.01 > REACH_M ? deepest + 0.01 : REACH_M;
    memcpy(s->origin, p, sizeof s->origin);
    s->near_radius = t->parameters.radius;
    s->ball = sqrt(s->near_radius * s->near_radius + depth * depth) + t->parameters.amplitude + SKIN_M;
    s->reach = least - s->ball > SKIN_M ? least - s->ball : SKIN_M;
    collect(t);
}

void tissue_restore(Tissue *t) {
    if (t->state.near_radius > 0) collect(t);
    else t->near.count = 0;
}

/* The field as it moves by itself: u += -h C^-1 K (u - sum y). */
static void relax(Tissue *t, double h) {
    const Matrices *m = t->matrices;
    const int32_t n = t->phantom->n, *first = m->first, *column = m->column;
    const double *relative = m->relative;
    double *u = t->field, *strain = t->strain;
    if (!t->state.disturbed) return;
    memcpy(strain, u, (size_t)n * sizeof(double));
    for (int k = 0; k < BRANCHES; k++) {
        const double *y = t->field + (size_t)(k + 1) * (size_t)n;
        if (t->parameters.prony_g[k] <= 0) continue;
        for (int32_t i = 0; i < n; i++) strain[i] -= y[i];
    }
    for (int32_t i = 0; i < n; i++) {
        double sum = 0;
        for (int32_t e = first[i]; e < first[i + 1]; e++) sum += relative[e] * strain[column[e]];
        u[i] -= h * sum;
    }
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
    const double limit = t->parameters.friction * load, stiffness = skin_stiffness(t);
    const double *w = in->spin;
    double *s = t->state.stretch, v[3], along = 0, pull;
    if (limit <= 0) {
        s[0] = s[1] = s[2] = 0;
        return;
    }
    v[0] = in->velocity[0] + w[1] * r[2] - w[2] * r[1];
    v[1] = in->velocity[1] + w[2] * r[0] - w[0] * r[2];
    v[2] = in->velocity[2] + w[0] * r[1] - w[1] * r[0];
    for (int k = 0; k < 3; k++) {
        s[k] += v[k] * h;
        along += s[k] * (push[k] / load);
    }
    for (int k = 0; k < 3; k++) s[k] -= along * (push[k] / load);
    pull = stiffness * sqrt(s[0] * s[0] + s[1] * s[1] + s[2] * s[2]);
    if (pull > limit) {
        for (int k = 0; k < 3; k++) s[k] *= limit / pull;
    }
    v[0] = -stiffness * s[0], v[1] = -stiffness * s[1], v[2] = -stiffness * s[2];
    for (int k = 0; k < 3; k++) force[k] += v[k];
    torque[0] += r[1] * v[2] - r[2] * v[1];
    torque[1] += r[2] * v[0] - r[0] * v[2];
    torque[2] += r[0] * v[1] - r[1] * v[0];
}

/* Holds the vertices under a sphere at `p` on it, and adds what that takes to force and torque. */
static void touch(Tissue *t, double h, const double *p, const Inputs *in, double *force, double *torque) {
    const Candidates *near = &t->near;
    const double radius = t->parameters.radius, rim = (RIM * radius) * (RIM * radius), excursion = t->state.excursion;
    double load = 0, push[3] = {0, 0, 0}, side[3] = {0, 0, 0}, point[3] = {0, 0, 0};
    int32_t contacts = 0;
    for (int32_t k = 0; k < near->count; k++) {
        const double *n = near->normals + 3 * k, *at = near->positions + 3 * k;
        const double x = at[0] - p[0], y = at[1] - p[1], z = at[2] - p[2];
        const double below = n[0] * x + n[1] * y + n[2] * z; /* of the centre under the vertex, along its inward normal */
        const double square = radius * radius - (x * x + y * y + z * z) + below * below;
        double half, hold, gap, f, steep;
        if (square <= rim) continue;
        half = sqrt(square);
        hold = below + half;
        gap = hold + excursion * near->breathing[k] - t->field[near->index[k]];
        if (gap <= 0) continue;
        t->field[near->index[k]] += gap;
        f = gap * (near->damping[k] / h);
        steep = f / half;
        contacts++;
        load += f;
        push[0] += f * n[0], push[1] += f * n[1], push[2] += f * n[2];
        side[0] += steep * (below * n[0] - x), side[1] += steep * (below * n[1] - y), side[2] += steep * (below * n[2] - z);
        point[0] += f * (x - hold * n[0]), point[1] += f * (y - hold * n[1]), point[2] += f * (z - hold * n[2]);
    }
    t->state.contacts = contacts;
    t->state.touching = contacts > 0;
    if (!contacts) {
        t->state.stretch[0] = t->state.stretch[1] = t->state.stretch[2] = 0;
        return;
    }
    t->state.disturbed = 1;
    for (int k = 0; k < 3; k++) {
        force[k] += push[k] + side[k];
        point[k] /= load;
    }
    rub(t, h, in, point, push, force, torque);
}

void tissue_step(Tissue *t, const Inputs *in, double dt, long count) {
    State *s = &t->state;
    const double begin = s->time, h = dt / (double)count;
    double from[3], force[3] = {0, 0, 0}, torque[3] = {0, 0, 0};
    memcpy(from, s->moved ? s->at : in->position, sizeof from);
    for (long k = 1; k <= count; k++) {
        const double share = (double)k / (double)count;
        double p[3];
        for (int j = 0; j < 3; j++) p[j] = k == count ? in->position[j] : from[j] + share * (in->position[j] - from[j]);
        s->excursion = tissue_excursion(&t->parameters, begin + dt * share);
        if (s->near_radius != t->parameters.radius || distance(p, s->origin) > s->reach) gather(t, p);
        relax(t, h);
        touch(t, h, p, in, force, torque);
        remember(t, h);
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
    const Matrices *m = t->matrices;
    double sum = 0;
    for (int32_t i = 0; i < t->phantom->n; i++) {
        double row = 0;
        for (int32_t e = m->first[i]; e < m->first[i + 1]; e++) {
            const int32_t j = m->column[e];
            row += m->value[e] * (y ? t->field[j] - y[j] / g : t->field[j]);
        }
        sum += row * (y ? t->field[i] - y[i] / g : t->field[i]);
    }
    return 0.5 * sum;
}

double tissue_energy(const Tissue *t) {
    const double *s = t->state.stretch;
    double held = 1, stored = 0.5 * skin_stiffness(t) * (s[0] * s[0] + s[1] * s[1] + s[2] * s[2]);
    for (int k = 0; k < BRANCHES; k++) {
        const double g = t->parameters.prony_g[k];
        if (g <= 0) continue;
        held -= g;
        stored += g * spring_energy(t, t->field + (size_t)(k + 1) * (size_t)t->phantom->n, g);
    }
    return stored + held * spring_energy(t, NULL, 1);
}
