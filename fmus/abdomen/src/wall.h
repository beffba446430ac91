/* The wall stiffens with depth, and a contracted muscle tenses it. The same law as palpate_models.wall. */
#ifndef PALPATE_WALL_H
#define PALPATE_WALL_H

#define MOST_STIFFENING 30.0 /* the modulus rises to 1 + this times that at rest, and no further */

/* Beyond this displacement [m] the modulus does not rise. */
static inline double wall_knee(double stiffening) { return MOST_STIFFENING / stiffening; }

/* sigma [m]: what stiffening adds to the displacement u [m] of a linear wall of equal pressure; `stiffening` in 1/m. */
static inline double wall_stiffening(double stiffening, double u) {
    if (u <= 0 || stiffening <= 0) return 0;
    if (u <= wall_knee(stiffening)) return 0.5 * stiffening * u * u;
    return MOST_STIFFENING * (u - 0.5 * wall_knee(stiffening));
}

/* d sigma / du [1]. */
static inline double wall_slope(double stiffening, double u) {
    if (u <= 0 || stiffening <= 0) return 0;
    return u <= wall_knee(stiffening) ? stiffening * u : MOST_STIFFENING;
}

/* The integral of sigma over u from 0 [m^2]. */
static inline double wall_work(double stiffening, double u) {
    double beyond;
    if (u <= 0 || stiffening <= 0) return 0;
    if (u <= wall_knee(stiffening)) return stiffening * u * u * u / 6;
    beyond = u - wall_knee(stiffening);
    return MOST_STIFFENING * (wall_knee(stiffening) * (wall_knee(stiffening) / 6 + beyond / 2) + beyond * beyond / 2);
}

/* The largest slope there is. */
static inline double wall_largest_slope(double stiffening) { return stiffening > 0 ? MOST_STIFFENING : 0; }

#endif
