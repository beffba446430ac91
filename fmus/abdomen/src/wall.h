/* The wall stiffens with depth. The same law as palpate_models.wall, of which it is the one place here. */
#ifndef PALPATE_WALL_H
#define PALPATE_WALL_H

#include <math.h>

#define MOST_STIFFENING 15.0 /* the modulus rises to 1 + this times that at rest, and no further */

/* The displacement u [m], or that from which the modulus rises no further; `stiffening` in 1/m. */
static inline double wall_bent(double stiffening, double u) {
    return stiffening * u > sqrt(MOST_STIFFENING) ? sqrt(MOST_STIFFENING) / stiffening : u;
}

/* sigma [m]: what stiffening adds to the displacement that a linear wall of equal pressure would have. */
static inline double wall_stress(double stiffening, double u) {
    const double bent = wall_bent(stiffening, u), rise = stiffening * bent;
    return u > 0 ? rise * rise * (u - 2 * bent / 3) : 0;
}

/* d sigma / du = min((stiffening u)^2, MOST_STIFFENING) [1]. */
static inline double wall_slope(double stiffening, double u) {
    const double rise = stiffening * wall_bent(stiffening, u);
    return u > 0 ? rise * rise : 0;
}

/* The integral of sigma over u from 0 [m^2]. */
static inline double wall_stored(double stiffening, double u) {
    const double bent = wall_bent(stiffening, u), rise = stiffening * bent;
    return u > 0 ? rise * rise * (u * u / 2 - 2 * bent * u / 3 + bent * bent / 4) : 0;
}

/* The largest slope there is. */
static inline double wall_largest_slope(double stiffening) { return stiffening > 0 ? MOST_STIFFENING : 0; }

#endif
