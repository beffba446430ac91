/* The matrices of the tissue: `C u' + K u = f`, and the bound within which an explicit step is stable and passive. */
#ifndef PALPATE_MATRICES_H
#define PALPATE_MATRICES_H

#include "parameters.h"
#include "phantom.h"

#define STEP_LIMIT 1.8 /* largest h * rate of a step: energy cannot grow below 2 */

typedef struct {
    double *k_w;      /* (n) foundation modulus with lesions [N/m^3] */
    double *plain;    /* (n) the same without lesions */
    int32_t *lesion;  /* (n) index of the lesion a vertex lies in, or -1 */
    double *damping;  /* (n) diagonal of C [N s/m] */
    int32_t *first;   /* (n + 1) rows of K; those of fixed vertices are empty */
    int32_t *column;
    double *value;    /* K [N/m] */
    double *relative; /* C^-1 K [1/s] */
    double *stiffening; /* (n) those of the phantom, but 0 where it is fixed [1/m] */
    double *straight;   /* (n) displacement from which a spring stiffens no further [m] */
    double *tension;    /* (n) as stiffening [1] */
    int stiffens;       /* whether either is anywhere above 0 */
    double *most;     /* (n) what stiffening and tensed muscle add at most to the diagonal of K [N/m] */
    double rate;      /* largest eigenvalue of C^-1 K with that added [1/s] */
    double *work;     /* (4 n) */
} Matrices;

Matrices *matrices_new(const Phantom *phantom);
void matrices_free(Matrices *matrices);

/* Assembles for a set of parameters. */
void matrices_assemble(Matrices *matrices, const Phantom *phantom, const Parameters *parameters);

/* Row i of a product with K (`value`) or C^-1 K (`relative`). */
static inline double matrices_row(const Matrices *matrices, const double *value, const double *x, int32_t i) {
    double sum = 0;
    for (int32_t e = matrices->first[i]; e < matrices->first[i + 1]; e++) sum += value[e] * x[matrices->column[e]];
    return sum;
}

/* How many equal steps a time `dt` [s] must be cut into; as a real number, as it may be huge. */
double matrices_substeps(const Matrices *matrices, double dt);

#endif
