/* Geometry of the surface: the rest point under the indenter, and the normals of the deformed mesh. */
#ifndef PALPATE_SURFACE_H
#define PALPATE_SURFACE_H

#include "phantom.h"

typedef struct {
    const Phantom *phantom;
    double *slope;   /* (m, 2, 3): maps an offset from the first corner to its barycentric coordinates [1/m] */
    double *area;    /* (m) twice the area of a triangle [m^2] */
    double *total;   /* (n) sum of it over the triangles at a vertex */
    int32_t *first;  /* (n + 1) where the triangles at a vertex start */
    int32_t *face;   /* (3 m) */
} Surface;

typedef struct {
    double position[3]; /* [m] */
    double normal[3];   /* outward, unit */
    double height;      /* of the queried point along it [m] */
    double k_w;         /* there [N/m^3] */
} RestPoint;

Surface *surface_new(const Phantom *phantom);
void surface_free(Surface *surface);

/* The rest point nearest to `p` (3) [m] at a breathing excursion [m]; k_w (n) is interpolated. */
RestPoint surface_nearest(const Surface *surface, const double *p, double excursion, const double *k_w);

/* How the rest point changes when p moves by `dp` [m] and the excursion by `dexcursion` [m]. */
RestPoint surface_nearest_along(const Surface *surface, const double *p, double excursion, const double *k_w, const double *dp,
                                double dexcursion);

/* Unit normals (n, 3) of the surface whose vertices have moved inward by (n) [m]: n + grad u, normalised. */
void surface_normals(const Surface *surface, const double *inward, double *normals);

#endif
