/* The tissue's step: an explicit field with contact solved exactly, vertex by vertex. See the README for the equations. */
#ifndef PALPATE_TISSUE_H
#define PALPATE_TISSUE_H

#include "contact.h"
#include "guarding.h"
#include "matrices.h"
#include "parameters.h"
#include "phantom.h"

/* All that a step changes, but for the field. Plain data, so that it can be copied and serialised. */
typedef struct {
    double time;        /* [s] */
    double at[3];       /* where the sphere was at the end of the last step [m] */
    double excursion;   /* of breathing [m] */
    double stretch[3];  /* of the skin by friction [m] */
    double activation;  /* how far guarding muscle is contracted, 0 to 1 [1] */
    double force[3];    /* on the sphere, mean of the last step [N] */
    double torque[3];   /* on the sphere about its centre [N m] */
    double origin[3];   /* where contact candidates were gathered [m] */
    double ball;        /* within this distance of it [m] */
    double reach;       /* how far the centre may go from there [m] */
    double near_radius; /* for this sphere [m]; 0: none gathered yet */
    int32_t moved;      /* whether `at` is known */
    int32_t disturbed;  /* whether anything ever touched; until then the field is left at its exact rest */
    int32_t touching;   /* whether the sphere holds a vertex */
    int32_t contacts;   /* how many */
} State;

typedef struct {
    const Phantom *phantom;
    const Matrices *matrices;
    Parameters parameters;
    State state;
    double *field; /* u, then y_k: (1 + BRANCHES, n) [m] */
    double *strain; /* (n), scratch */
    Candidates near;
    int32_t deepest; /* of the vertices that the sphere holds; -1: none */
} Tissue;

Tissue *tissue_new(const Phantom *phantom, const Matrices *matrices);
void tissue_free(Tissue *tissue);

/* Back to rest at `time` [s]. */
void tissue_reset(Tissue *tissue, double time);

/* Starts at `time` [s] from the field and the stretch that are there. */
void tissue_begin(Tissue *tissue, double time);

/* u - sum y (n) [m]: what the springs feel. */
void tissue_strain(const Tissue *tissue, double *strain);

/* Advances by `dt` [s] in equal periods, each of which is cut into equal sub-steps. The sphere moves straight from where it was to
 * inputs->position; muscle answers at the end of each period. */
void tissue_step(Tissue *tissue, const Inputs *inputs, double dt, long periods, long substeps);

/* After state and field were replaced: gathers the contact candidates that belong to them. */
void tissue_restore(Tissue *tissue);

/* Breathing excursion [m] at a time [s]. */
double tissue_excursion(const Tissue *tissue, double time);

/* How fast it changes [m/s]. */
double tissue_excursion_rate(const Tissue *tissue, double time);

/* The largest there is [m]. */
double tissue_largest_excursion(const Tissue *tissue);

/* What stiffening and tensed muscle add to the displacement that the foundation of vertex i answers [m]. */
double tissue_stiffening(const Tissue *tissue, int32_t i);

/* How it changes when the displacement changes by `du` [m] and the activation by `dactivation`. */
double tissue_stiffening_along(const Tissue *tissue, int32_t i, double du, double dactivation);

/* How the sphere presses a vertex that it holds. */
Press tissue_press(const Tissue *tissue, const Inputs *inputs, int32_t i);

/* How far vertex i is from its place at rest [m] along its inward normal, breathing included. */
double tissue_inward(const Tissue *tissue, int32_t i);

/* Elastic energy [J] stored in springs, Maxwell branches and the sheared skin. */
double tissue_energy(const Tissue *tissue);

#endif
