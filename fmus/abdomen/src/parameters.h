/* Parameters and inputs of the tissue, in SI units and in the abdomen frame A. */
#ifndef PALPATE_PARAMETERS_H
#define PALPATE_PARAMETERS_H

#include <stdint.h>

#define BRANCHES 4
#define LESIONS 8

typedef struct {
    double radius;                   /* of the indenter [m] */
    double scale;                    /* factor on all stiffness [1] */
    double length;                   /* Pasternak length l [m] */
    double dashpot;                  /* C / (k_w A) [s] */
    double friction;                 /* Coulomb coefficient [1] */
    double breathing;                /* factor on the excursion of all breaths [1] */
    double breathing_offset;         /* how far the breaths are ahead [s] */
    double contact_time;             /* within which contact and friction are restored in model exchange [s] */
    double prony_g[BRANCHES];        /* relaxing fractions [1] */
    double prony_tau[BRANCHES];      /* time constants [s] */
    double lesion_centre[2 * LESIONS]; /* [m] */
    double lesion_radii[2 * LESIONS];  /* half axes of the half-contrast outline [m] */
    double lesion_contrast[LESIONS];   /* [1] */
    double lesion_edge[LESIONS];       /* width of the smooth edge [m] */
    int32_t lesion_count;
    int32_t voluntary;               /* whether guarding fades under gentle pressure */
} Parameters;

typedef struct {
    double position[3]; /* of the sphere's centre at the end of the step [m] */
    double velocity[3]; /* of the sphere's centre [m/s] */
    double spin[3];     /* of the sphere [rad/s] */
} Inputs;

#endif
