/* How the contraction of voluntarily guarding muscle comes and goes. The same law as palpate_models.patient.wall. */
#ifndef PALPATE_GUARDING_H
#define PALPATE_GUARDING_H

/* How the skin is pressed: how deep where it is deepest [m], and how fast it is pushed in there [m/s]. */
typedef struct {
    double depth;
    double speed;
} Press;

/* The contraction that a press provokes, 0 to 1. */
double guarding_provoked(Press press);

/* How that changes when the press changes. */
double guarding_provoked_along(Press press, Press change);

/* Time constant [s] of a contraction on its way to the provoked one. */
double guarding_time(double activation, double provoked);

/* The contraction after `dt` [s] of the same press. */
double guarding_after(double activation, Press press, double dt);

#endif
