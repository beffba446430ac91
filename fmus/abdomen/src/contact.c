#include "contact.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define RIM 0.2 /* the sphere holds vertices up to 78 degrees from its pole (cos > 0.2) */

/* Mindlin's tangential stiffness 8 a G / (2 - nu) of a sticking contact; k_w = 1.7e5 N/m^3 stands for E = 10 kPa. */
#define REFERENCE_K_W 1.7e5
#define REFERENCE_E 1.0e4
#define REFERENCE_RADIUS_M 0.012
#define POISSON 0.49

int candidates_new(Candidates *near, size_t n) {
    near->count = 0;
    near->index = calloc(n, sizeof(int32_t));
    near->normals = calloc(3 * n, sizeof(double));
    near->positions = calloc(3 * n, sizeof(double));
    near->breathing = calloc(n, sizeof(double));
    near->damping = calloc(n, sizeof(double));
    return near->index && near->normals && near->positions && near->breathing && near->damping;
}

void candidates_free(Candidates *near) {
    free(near->index);
    free(near->normals);
    free(near->positions);
    free(near->breathing);
    free(near->damping);
}

double contact_distance(const double *a, const double *b) {
    const double x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2];
    return sqrt(x * x + y * y + z * z);
}

void candidates_collect(Candidates *near, const Phantom *p, const Matrices *matrices, const double *origin, double radius,
                        double ball) {
    const double *facing;
    int32_t nearest = -1;
    double least = HUGE_VAL;
    for (int32_t i = 0; i < p->n; i++) {
        if (!p->fixed[i]) {
            const double d = contact_distance(origin, p->vertices + 3 * i);
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
        if (p->fixed[i] || contact_distance(origin, at) > ball) continue;
        x = at[0] - origin[0], y = at[1] - origin[1], z = at[2] - origin[2];
        height = n[0] * x + n[1] * y + n[2] * z;
        x -= height * n[0], y -= height * n[1], z -= height * n[2];
        if (sqrt(x * x + y * y + z * z) >= radius + SKIN_M) continue;
        if (n[0] * facing[0] + n[1] * facing[1] + n[2] * facing[2] <= 0) continue; /* the far side of something thin */
        k = near->count++;
        near->index[k] = i;
        memcpy(near->normals + 3 * k, n, 3 * sizeof(double));
        memcpy(near->positions + 3 * k, at, 3 * sizeof(double));
        near->breathing[k] = p->breathing[i];
        near->damping[k] = matrices->damping[i];
    }
}

int contact_hold(const Candidates *near, int32_t k, const double *p, double radius, Hold *hold) {
    const double *n = near->normals + 3 * k, *at = near->positions + 3 * k;
    const double x = at[0] - p[0], y = at[1] - p[1], z = at[2] - p[2];
    const double below = n[0] * x + n[1] * y + n[2] * z;
    const double square = radius * radius - (x * x + y * y + z * z) + below * below;
    if (square <= (RIM * radius) * (RIM * radius)) return 0;
    hold->x[0] = x, hold->x[1] = y, hold->x[2] = z;
    hold->below = below;
    hold->half = sqrt(square);
    hold->hold = below + hold->half;
    return 1;
}

void contact_add(Grip *grip, const double *n, const Hold *hold, double f) {
    const double steep = f / hold->half;
    grip->count++;
    grip->load += f;
    for (int k = 0; k < 3; k++) {
        grip->push[k] += f * n[k];
        grip->side[k] += steep * (hold->below * n[k] - hold->x[k]);
        grip->point[k] += f * (hold->x[k] - hold->hold * n[k]);
    }
}

double contact_skin_stiffness(const Phantom *phantom, const Parameters *parameters) {
    const double k_w = parameters->scale * phantom->median_background;
    const double modulus = REFERENCE_E * k_w / REFERENCE_K_W / (2 * (1 + POISSON));
    return 8 * REFERENCE_RADIUS_M * modulus / (2 - POISSON);
}

void contact_slip(const Inputs *in, const double *r, double *velocity) {
    const double *w = in->spin;
    velocity[0] = in->velocity[0] + w[1] * r[2] - w[2] * r[1];
    velocity[1] = in->velocity[1] + w[2] * r[0] - w[0] * r[2];
    velocity[2] = in->velocity[2] + w[0] * r[1] - w[1] * r[0];
}

void contact_stick(const double *push, double limit, double stiffness, double *s) {
    const double load = sqrt(push[0] * push[0] + push[1] * push[1] + push[2] * push[2]);
    double along = 0, pull;
    for (int k = 0; k < 3; k++) along += s[k] * (push[k] / load);
    for (int k = 0; k < 3; k++) s[k] -= along * (push[k] / load);
    pull = stiffness * sqrt(s[0] * s[0] + s[1] * s[1] + s[2] * s[2]);
    if (pull > limit) {
        for (int k = 0; k < 3; k++) s[k] *= limit / pull;
    }
}

void contact_pull(double stiffness, const double *s, const double *r, double *force, double *torque) {
    double f[3];
    for (int k = 0; k < 3; k++) f[k] = -stiffness * s[k];
    for (int k = 0; k < 3; k++) force[k] += f[k];
    torque[0] += r[1] * f[2] - r[2] * f[1];
    torque[1] += r[2] * f[0] - r[0] * f[2];
    torque[2] += r[0] * f[1] - r[1] * f[0];
}
