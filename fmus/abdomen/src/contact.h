/* A sphere against the surface: which vertices it may hold, how deep, and what that takes. Frame A, SI units. */
#ifndef PALPATE_CONTACT_H
#define PALPATE_CONTACT_H

#include "matrices.h"
#include "parameters.h"
#include "phantom.h"

#define SKIN_M 0.0025 /* candidates stay complete while the sphere moves this far */

/* Contact candidates: gathered into contiguous memory, `count` of them. */
typedef struct {
    int32_t count;
    int32_t *index;
    double *normals;   /* (count, 3) */
    double *positions; /* (count, 3) [m] */
    double *breathing;
    double *damping;   /* [N s/m] */
} Candidates;

/* Where a sphere holds a vertex: `hold = below + half` along the inward normal. */
typedef struct {
    double x[3];  /* of the vertex at rest from the sphere's centre [m] */
    double below; /* of the centre under the vertex [m] */
    double half;  /* from there to the sphere's surface [m] */
    double hold;  /* [m] */
} Hold;

/* Sums over the vertices that a sphere holds. */
typedef struct {
    double load;     /* [N] */
    double push[3];  /* along the normals at rest [N] */
    double side[3];  /* what the sphere's own normals add [N] */
    double point[3]; /* first moment of the load about the centre [N m]; then the contact's place [m] */
    int32_t count;
} Grip;

/* Room for all of n vertices; 0 if there is no memory. */
int candidates_new(Candidates *near, size_t n);
void candidates_free(Candidates *near);

/* The vertices that a sphere near `origin` might hold: within `ball` of it, and on the side that faces it. */
void candidates_collect(Candidates *near, const Phantom *phantom, const Matrices *matrices, const double *origin, double radius,
                        double ball);

/* Whether a sphere at `p` reaches candidate k, and where it holds it. */
int contact_hold(const Candidates *near, int32_t k, const double *p, double radius, Hold *hold);

/* Adds a vertex that is held by a force f [N] along its normal n. */
void contact_add(Grip *grip, const double *n, const Hold *hold, double f);

/* Mindlin's tangential stiffness of the skin [N/m]. */
double contact_skin_stiffness(const Phantom *phantom, const Parameters *parameters);

/* Velocity [m/s] of the sphere at a place r from its centre. */
void contact_slip(const Inputs *inputs, const double *r, double *velocity);

/* Brings the bristle s [m] into the plane across `push`, and shortens it to what friction carries. */
void contact_stick(const double *push, double limit, double stiffness, double *s);

/* Adds the pull of the bristle, which acts at r from the centre. */
void contact_pull(double stiffness, const double *s, const double *r, double *force, double *torque);

double contact_distance(const double *a, const double *b);

#endif
