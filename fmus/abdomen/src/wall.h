/* The wall stiffens with depth. The same law as palpate_models.patient.wall, of which this is the one place here.
 *
 * `stiffening` is beta [1/m], `straight` the displacement u_c [m] from which the spring that stiffens is straight. */
#ifndef PALPATE_WALL_H
#define PALPATE_WALL_H

#include <math.h>

#define MOST_STIFFENING 15.0 /* the modulus rises to 1 + this times that at rest, and no further */

static inline double wall_straight(double stiffening) { return stiffening > 0 ? sqrt(MOST_STIFFENING) / stiffening : HUGE_VAL; }

static inline double wall_pressed(double u) { return u > 0 ? u : 0; }

static inline double wall_bent(double u, double straight) { return wall_pressed(u) < straight ? wall_pressed(u) : straight; }

/* sigma(u) [m]: what stiffening adds to the displacement that a linear wall of equal pressure would have. */
static inline double wall_stress(double u, double stiffening, double straight) {
    const double bent = wall_bent(u, straight), rise = stiffening * bent;
    return rise * rise * (wall_pressed(u) - 2.0 / 3 * bent);
}

/* sigma'(u) = min((beta u)^2, MOST_STIFFENING) [1]. */
static inline double wall_slope(double u, double stiffening, double straight) {
    const double rise = stiffening * wall_bent(u, straight);
    return rise * rise;
}

/* The integral of sigma over u from 0 [m^2]. */
static inline double wall_stored(double u, double stiffening, double straight) {
    const double bent = wall_bent(u, straight), rise = stiffening * bent, pressed = wall_pressed(u);
    return rise * rise * (pressed * pressed / 2 - 2.0 / 3 * bent * pressed + bent * bent / 4);
}

/* The largest slope there is [1]. */
static inline double wall_largest_slope(double stiffening) { return stiffening > 0 ? MOST_STIFFENING : 0; }

#endif
