#include "surface.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define FAR_M 0.15 /* further away than this, the nearest vertex stands for the nearest point */

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void minus(const double *a, const double *b, double *out) {
    for (int k = 0; k < 3; k++) out[k] = a[k] - b[k];
}

Surface *surface_new(const Phantom *p) {
    const size_t n = (size_t)p->n, m = (size_t)p->m;
    Surface *s = calloc(1, sizeof *s);
    if (!s) return NULL;
    s->phantom = p;
    s->slope = calloc(6 * m, sizeof(double));
    s->area = calloc(m, sizeof(double));
    s->total = calloc(n, sizeof(double));
    s->first = calloc(n + 2, sizeof(int32_t));
    s->face = calloc(3 * m, sizeof(int32_t));
    if (!s->slope || !s->area || !s->total || !s->first || !s->face) {
        surface_free(s);
        return NULL;
    }
    for (size_t f = 0; f < m; f++) {
        const int32_t *corner = p->triangles + 3 * f;
        double a[3], b[3], aa, bb, ab, det;
        minus(p->vertices + 3 * corner[1], p->vertices + 3 * corner[0], a);
        minus(p->vertices + 3 * corner[2], p->vertices + 3 * corner[0], b);
        aa = dot(a, a), bb = dot(b, b), ab = dot(a, b);
        det = aa * bb - ab * ab;
        if (det <= 0) det = 1e-300;
        for (int k = 0; k < 3; k++) {
            s->slope[6 * f + (size_t)k] = (bb * a[k] - ab * b[k]) / det;
            s->slope[6 * f + 3 + (size_t)k] = (aa * b[k] - ab * a[k]) / det;
            s->first[corner[k] + 2]++;
        }
        s->area[f] = sqrt(det);
        for (int k = 0; k < 3; k++) s->total[corner[k]] += s->area[f];
    }
    for (size_t i = 1; i < n + 2; i++) s->first[i] += s->first[i - 1];
    for (size_t c = 0; c < 3 * m; c++) s->face[s->first[p->triangles[c] + 1]++] = (int32_t)(c / 3);
    return s;
}

void surface_free(Surface *s) {
    if (!s) return;
    free(s->slope);
    free(s->area);
    free(s->total);
    free(s->first);
    free(s->face);
    free(s);
}

static double clip(double t) { return t < 0 ? 0 : t > 1 ? 1 : t; }

/* Barycentric coordinates of the point of triangle f that is nearest to p; returns its squared distance. */
static double nearest_in_face(const Phantom *ph, int32_t f, const double *p, double *weights) {
    static const int EDGES[3][2] = {{0, 1}, {1, 2}, {2, 0}};
    const double *corner[3];
    double ab[3], ac[3], ap[3], d11, d12, d22, d1, d2, det, at[3], square = 0;
    for (int k = 0; k < 3; k++) corner[k] = ph->vertices + 3 * ph->triangles[3 * f + k];
    minus(corner[1], corner[0], ab);
    minus(corner[2], corner[0], ac);
    minus(p, corner[0], ap);
    d11 = dot(ab, ab), d12 = dot(ab, ac), d22 = dot(ac, ac), d1 = dot(ab, ap), d2 = dot(ac, ap);
    det = d11 * d22 - d12 * d12;
    weights[1] = (d22 * d1 - d12 * d2) / det;
    weights[2] = (d11 * d2 - d12 * d1) / det;
    weights[0] = 1 - weights[1] - weights[2];
    if (weights[0] < 0 || weights[1] < 0 || weights[2] < 0) {
        double least = HUGE_VAL;
        for (int e = 0; e < 3; e++) {
            const int i = EDGES[e][0], j = EDGES[e][1];
            double edge[3], offset[3], t, away = 0;
            minus(corner[j], corner[i], edge);
            minus(p, corner[i], offset);
            t = clip(dot(offset, edge) / dot(edge, edge));
            for (int k = 0; k < 3; k++) away += (offset[k] - t * edge[k]) * (offset[k] - t * edge[k]);
            if (away < least) {
                least = away;
                weights[0] = weights[1] = weights[2] = 0;
                weights[i] = 1 - t;
                weights[j] = t;
            }
        }
    }
    for (int k = 0; k < 3; k++) {
        at[k] = weights[0] * corner[0][k] + weights[1] * corner[1][k] + weights[2] * corner[2][k];
        square += (p[k] - at[k]) * (p[k] - at[k]);
    }
    return square;
}

/* The triangle at a vertex that is nearest to p, with the nearest point's barycentric coordinates. */
static int32_t project(const Surface *s, int32_t vertex, const double *p, double *weights) {
    double best = -HUGE_VAL, least = HUGE_VAL, trial[3];
    int32_t chosen = -1;
    for (int32_t e = s->first[vertex]; e < s->first[vertex + 1]; e++) {
        const int32_t f = s->face[e];
        double offset[3], v, w, margin;
        minus(p, s->phantom->vertices + 3 * s->phantom->triangles[3 * f], offset);
        v = dot(s->slope + 6 * f, offset);
        w = dot(s->slope + 6 * f + 3, offset);
        margin = v < w ? v : w;
        if (1 - (v + w) < margin) margin = 1 - (v + w);
        if (margin > best) {
            best = margin;
            chosen = f;
            weights[0] = 1 - v - w, weights[1] = v, weights[2] = w;
        }
    }
    if (best >= 0) return chosen; /* over one face; over several only beneath a concave edge, where they hardly differ */
    for (int32_t e = s->first[vertex]; e < s->first[vertex + 1]; e++) {
        const double square = nearest_in_face(s->phantom, s->face[e], p, trial);
        if (square < least) {
            least = square;
            chosen = s->face[e];
            memcpy(weights, trial, sizeof trial);
        }
    }
    return chosen;
}

/* What the rest point is made of: three corners with weights, and the vertex whose breathing moves them. */
typedef struct {
    int32_t vertex;
    int32_t corners[3];
    int32_t face; /* -1: the vertex alone */
    double weights[3];
    int far;
} Foot;

static Foot find_foot(const Surface *s, const double *p, double excursion) {
    const Phantom *ph = s->phantom;
    Foot foot = {0, {0, 0, 0}, -1, {1, 0, 0}, 0};
    double least = HUGE_VAL, moved[3];
    for (int32_t i = 0; i < ph->n; i++) {
        double d[3];
        minus(p, ph->vertices + 3 * i, d);
        if (dot(d, d) < least) {
            least = dot(d, d);
            foot.vertex = i;
        }
    }
    foot.far = sqrt(least) > FAR_M;
    foot.corners[0] = foot.corners[1] = foot.corners[2] = foot.vertex;
    if (!foot.far && s->first[foot.vertex] < s->first[foot.vertex + 1]) {
        for (int k = 0; k < 3; k++) {
            moved[k] = p[k] - excursion * ph->breathing[foot.vertex] * ph->normals[3 * foot.vertex + k];
        }
        foot.face = project(s, foot.vertex, moved, foot.weights);
        if (foot.face >= 0) memcpy(foot.corners, ph->triangles + 3 * foot.face, sizeof foot.corners);
    }
    return foot;
}

RestPoint surface_nearest(const Surface *s, const double *p, double excursion, const double *k_w) {
    const Phantom *ph = s->phantom;
    const Foot foot = find_foot(s, p, excursion);
    RestPoint rest;
    double offset[3], length, lift = 0;
    memset(&rest, 0, sizeof rest);
    for (int c = 0; c < 3; c++) {
        for (int k = 0; k < 3; k++) {
            rest.normal[k] += foot.weights[c] * ph->normals[3 * foot.corners[c] + k];
            rest.position[k] += foot.weights[c] * ph->vertices[3 * foot.corners[c] + k];
        }
        lift += foot.weights[c] * ph->breathing[foot.corners[c]];
        rest.k_w += foot.weights[c] * k_w[foot.corners[c]];
    }
    length = sqrt(dot(rest.normal, rest.normal));
    for (int k = 0; k < 3; k++) {
        rest.normal[k] /= length;
        rest.position[k] += excursion * lift * rest.normal[k];
    }
    minus(p, rest.position, offset);
    rest.height = foot.far ? sqrt(dot(offset, offset)) : dot(offset, rest.normal);
    return rest;
}

/* How the weights change when the point that was projected moves by dm: not at a corner, along an edge, linearly in a face. */
static void weights_along(const Surface *s, const Foot *foot, const double *dm, double *change) {
    const Phantom *ph = s->phantom;
    int inner[3], count = 0;
    memset(change, 0, 3 * sizeof *change);
    if (foot->face < 0) return;
    for (int c = 0; c < 3; c++) {
        if (foot->weights[c] > 0) inner[count++] = c;
    }
    if (count == 3) {
        change[1] = dot(s->slope + 6 * foot->face, dm);
        change[2] = dot(s->slope + 6 * foot->face + 3, dm);
        change[0] = -change[1] - change[2];
    } else if (count == 2) {
        double edge[3];
        minus(ph->vertices + 3 * foot->corners[inner[1]], ph->vertices + 3 * foot->corners[inner[0]], edge);
        change[inner[1]] = dot(edge, dm) / dot(edge, edge);
        change[inner[0]] = -change[inner[1]];
    }
}

RestPoint surface_nearest_along(const Surface *s, const double *p, double excursion, const double *k_w, const double *dp,
                                double dexcursion) {
    const Phantom *ph = s->phantom;
    const Foot foot = find_foot(s, p, excursion);
    const RestPoint rest = surface_nearest(s, p, excursion, k_w);
    RestPoint change;
    double dm[3], weight[3], blend[3] = {0, 0, 0}, offset[3], length, along, lift = 0, dlift = 0;
    for (int k = 0; k < 3; k++) dm[k] = dp[k] - dexcursion * ph->breathing[foot.vertex] * ph->normals[3 * foot.vertex + k];
    weights_along(s, &foot, dm, weight);
    memset(&change, 0, sizeof change);
    for (int c = 0; c < 3; c++) {
        for (int k = 0; k < 3; k++) {
            blend[k] += foot.weights[c] * ph->normals[3 * foot.corners[c] + k];
            change.normal[k] += weight[c] * ph->normals[3 * foot.corners[c] + k];
            change.position[k] += weight[c] * ph->vertices[3 * foot.corners[c] + k];
        }
        lift += foot.weights[c] * ph->breathing[foot.corners[c]];
        dlift += weight[c] * ph->breathing[foot.corners[c]];
        change.k_w += weight[c] * k_w[foot.corners[c]];
    }
    length = sqrt(dot(blend, blend));
    along = dot(rest.normal, change.normal);
    minus(p, rest.position, offset);
    for (int k = 0; k < 3; k++) {
        change.normal[k] = (change.normal[k] - rest.normal[k] * along) / length;
        change.position[k] += (dexcursion * lift + excursion * dlift) * rest.normal[k] + excursion * lift * change.normal[k];
    }
    minus(dp, change.position, dm);
    change.height = foot.far ? dot(offset, dm) / rest.height : dot(dm, rest.normal) + dot(offset, change.normal);
    return change;
}

void surface_normals(const Surface *s, const double *inward, double *normals) {
    const Phantom *ph = s->phantom;
    memset(normals, 0, 3 * (size_t)ph->n * sizeof(double));
    for (int32_t f = 0; f < ph->m; f++) {
        const int32_t *corner = ph->triangles + 3 * f;
        const double du = inward[corner[1]] - inward[corner[0]], dv = inward[corner[2]] - inward[corner[0]];
        const double *slope = s->slope + 6 * f;
        for (int k = 0; k < 3; k++) {
            const double weighted = s->area[f] * (du * slope[k] + dv * slope[3 + k]);
            for (int c = 0; c < 3; c++) normals[3 * corner[c] + k] += weighted;
        }
    }
    for (int32_t i = 0; i < ph->n; i++) {
        double *n = normals + 3 * i, length;
        for (int k = 0; k < 3; k++) n[k] = ph->normals[3 * i + k] + (s->total[i] > 0 ? n[k] / s->total[i] : 0);
        length = sqrt(dot(n, n));
        for (int k = 0; k < 3; k++) n[k] /= length;
    }
}
