#include "matrices.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "wall.h"

#define LANCZOS 100

static double smoothstep(double t) {
    t = t < 0 ? 0 : t > 1 ? 1 : t;
    return t * t * (3 - 2 * t);
}

/* Distance [m] of (x, y) from a lesion's half-contrast ellipse, to first order; negative inside. */
static double edge_distance(double x, double y, const double *centre, const double *radii) {
    const double dx = x - centre[0], dy = y - centre[1];
    const double ax = dx / radii[0], ay = dy / radii[1];
    const double bx = dx / (radii[0] * radii[0]), by = dy / (radii[1] * radii[1]);
    const double rho = sqrt(ax * ax + ay * ay), slope = sqrt(bx * bx + by * by);
    if (rho > 1e-6) return (rho - 1) * rho / (slope > 1e-9 ? slope : 1e-9);
    return -(radii[0] < radii[1] ? radii[0] : radii[1]);
}

/* k_w with and without lesions; where lesions overlap, the stronger one counts. */
static void stiffen(Matrices *s, const Phantom *phantom, const Parameters *par) {
    for (int32_t i = 0; i < phantom->n; i++) {
        const double *at = phantom->vertices + 3 * i;
        const int front = phantom->normals[3 * i + 2] > 0;
        double factor = 1;
        int32_t label = -1;
        for (int32_t k = 0; k < par->lesion_count; k++) {
            const double distance = edge_distance(at[0], at[1], par->lesion_centre + 2 * k, par->lesion_radii + 2 * k);
            const double share = front ? smoothstep(0.5 - distance / par->lesion_edge[k]) : 0;
            const double own = 1 + (par->lesion_contrast[k] - 1) * share;
            const int stronger = fabs(log(own)) > fabs(log(factor));
            if (share >= 0.5 && (stronger || label < 0)) label = k;
            if (stronger) factor = own;
        }
        s->plain[i] = par->scale * phantom->background[i];
        s->k_w[i] = s->plain[i] * factor;
        s->lesion[i] = label;
    }
}

Matrices *matrices_new(const Phantom *phantom) {
    const size_t n = (size_t)phantom->n, nnz = (size_t)phantom->nnz + n;
    Matrices *s = calloc(1, sizeof *s);
    if (!s) return NULL;
    s->k_w = calloc(n, sizeof(double));
    s->plain = calloc(n, sizeof(double));
    s->lesion = calloc(n, sizeof(int32_t));
    s->damping = calloc(n, sizeof(double));
    s->first = calloc(n + 1, sizeof(int32_t));
    s->column = calloc(nnz, sizeof(int32_t));
    s->value = calloc(nnz, sizeof(double));
    s->relative = calloc(nnz, sizeof(double));
    s->stiffening = calloc(n, sizeof(double));
    s->straight = calloc(n, sizeof(double));
    s->tension = calloc(n, sizeof(double));
    s->most = calloc(n, sizeof(double));
    s->work = calloc(4 * n, sizeof(double));
    if (!s->k_w || !s->plain || !s->lesion || !s->damping || !s->first || !s->column || !s->value || !s->relative || !s->stiffening ||
        !s->straight || !s->tension || !s->most || !s->work) {
        matrices_free(s);
        return NULL;
    }
    for (size_t i = 0; i < n; i++) {
        s->stiffening[i] = phantom->fixed[i] ? 0 : phantom->stiffening[i];
        s->straight[i] = wall_straight(s->stiffening[i]);
        s->tension[i] = phantom->fixed[i] ? 0 : phantom->tension[i];
        s->stiffens |= s->stiffening[i] > 0 || s->tension[i] > 0;
    }
    return s;
}

void matrices_free(Matrices *s) {
    if (!s) return;
    free(s->k_w);
    free(s->plain);
    free(s->lesion);
    free(s->damping);
    free(s->first);
    free(s->column);
    free(s->value);
    free(s->relative);
    free(s->stiffening);
    free(s->straight);
    free(s->tension);
    free(s->most);
    free(s->work);
    free(s);
}

/* K of the free vertices: an edge carries the harmonic mean of the G = k_w l^2 of its ends. */
static void assemble(Matrices *s, const Phantom *p, double length) {
    int32_t used = 0;
    for (int32_t i = 0; i < p->n; i++) {
        const double own = s->k_w[i] * (length * length);
        double borne = 0;
        int32_t diagonal = -1;
        s->first[i] = used;
        if (p->fixed[i]) continue;
        for (int32_t e = p->first[i]; e < p->first[i + 1]; e++) {
            const int32_t j = p->column[e];
            double other, carried;
            if (diagonal < 0 && j >= i) {
                diagonal = used;
                s->column[used++] = i;
            }
            if (j == i) continue;
            other = s->k_w[j] * (length * length);
            carried = -p->laplacian[e] * 2 * own * other / (own + other);
            borne += carried;
            if (p->fixed[j]) continue;
            s->column[used] = j;
            s->value[used++] = -carried;
        }
        if (diagonal < 0) {
            diagonal = used;
            s->column[used++] = i;
        }
        s->value[diagonal] = s->k_w[i] * p->areas[i] + borne;
    }
    s->first[p->n] = used;
}

/* Eigenvalues below x of the symmetric tridiagonal matrix (a, b), by Sturm's sequence. */
static int count_below(const double *a, const double *b, int size, double x) {
    int count = 0;
    double d = 1;
    for (int k = 0; k < size; k++) {
        d = a[k] - x - (k ? b[k - 1] * b[k - 1] / d : 0);
        if (d == 0) d = 1e-300;
        count += d < 0;
    }
    return count;
}

static double largest_eigenvalue(const double *a, const double *b, int size, double high) {
    double low = 0;
    for (int k = 0; k < 60; k++) {
        const double middle = 0.5 * (low + high);
        if (count_below(a, b, size, middle) < size) low = middle;
        else high = middle;
    }
    return high;
}

/* Largest eigenvalue of C^-1 K, K at its stiffest, by Lanczos on C^-1/2 K C^-1/2, with a margin, at most Gershgorin's bound. */
static double largest_rate(Matrices *s, int32_t n) {
    double *v = s->work, *before = v + n, *w = before + n, *root = w + n;
    double a[LANCZOS], b[LANCZOS], norm = 0, gershgorin = 0, found;
    int size = 0;
    for (int32_t i = 0; i < n; i++) {
        double row = s->most[i];
        for (int32_t e = s->first[i]; e < s->first[i + 1]; e++) row += fabs(s->value[e]);
        if (row / s->damping[i] > gershgorin) gershgorin = row / s->damping[i];
        root[i] = sqrt(s->damping[i]);
        before[i] = 0;
        v[i] = s->first[i] < s->first[i + 1] ? 1 + (i % 7) / 7.0 : 0;
        norm += v[i] * v[i];
    }
    for (int32_t i = 0; i < n; i++) v[i] /= sqrt(norm);
    while (size < LANCZOS) {
        double alpha = 0, beta = 0;
        for (int32_t i = 0; i < n; i++) {
            double sum = s->most[i] * v[i] / root[i];
            for (int32_t e = s->first[i]; e < s->first[i + 1]; e++) sum += s->value[e] * v[s->column[e]] / root[s->column[e]];
            w[i] = sum / root[i] - (size ? b[size - 1] * before[i] : 0);
            alpha += w[i] * v[i];
        }
        for (int32_t i = 0; i < n; i++) {
            w[i] -= alpha * v[i];
            beta += w[i] * w[i];
        }
        a[size] = alpha;
        b[size++] = beta = sqrt(beta);
        if (beta < 1e-12 * gershgorin) break;
        for (int32_t i = 0; i < n; i++) {
            before[i] = v[i];
            v[i] = w[i] / beta;
        }
    }
    if (!isfinite(norm) || !isfinite(gershgorin)) return HUGE_VAL;
    found = 1.01 * largest_eigenvalue(a, b, size, gershgorin);
    return found < gershgorin ? found : gershgorin;
}

void matrices_assemble(Matrices *s, const Phantom *phantom, const Parameters *par) {
    stiffen(s, phantom, par);
    assemble(s, phantom, par->length);
    for (int32_t i = 0; i < phantom->n; i++) {
        s->damping[i] = par->dashpot * s->k_w[i] * phantom->areas[i];
        s->most[i] = s->k_w[i] * phantom->areas[i] * (wall_largest_slope(s->stiffening[i]) + s->tension[i]);
        for (int32_t e = s->first[i]; e < s->first[i + 1]; e++) s->relative[e] = s->value[e] / s->damping[i];
    }
    s->rate = largest_rate(s, phantom->n);
}

double matrices_substeps(const Matrices *s, double dt) {
    const double count = ceil(dt * s->rate / STEP_LIMIT);
    return count > 1 ? count : 1;
}
