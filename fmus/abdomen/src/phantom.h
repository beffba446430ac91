/* A phantom at rest, as the exporter wrote it. Frame A, SI units. */
#ifndef PALPATE_PHANTOM_H
#define PALPATE_PHANTOM_H

#include <stddef.h>
#include <stdint.h>

typedef struct {
    double start;       /* [s] */
    double inspiration; /* how long the wall rises [s] */
    double expiration;  /* how long it falls [s] */
    double pause;       /* until the next breath [s] */
    double amplitude;   /* outward [m] */
} Breath;

typedef struct {
    char token[65];           /* instantiation token of the FMU it belongs to */
    int32_t n;                /* vertices */
    int32_t nnz;              /* entries of the Laplacian */
    int32_t m;                /* triangles */
    int32_t samples;          /* vertices whose displacement FMI 2.0 shows */
    int32_t values;           /* start values of parameters */
    int32_t branches;         /* Prony branches that are continuous states in model exchange */
    int32_t breaths;          /* drawn; the table repeats */
    double median_background; /* [N/m^3] */
    double *start;            /* start values, in the order of the settable rows, shape (values) */
    double *vertices;         /* (n, 3) [m] */
    double *normals;          /* (n, 3), outward, unit */
    double *areas;            /* (n) [m^2] */
    double *background;       /* (n) k_w without lesions [N/m^3] */
    double *stiffening;       /* (n) how fast the modulus rises with depth [1/m] */
    double *tension;          /* (n) what contracted muscle adds to the modulus, over k_w [1] */
    double *breathing;        /* (n) share of the excursion */
    double *laplacian;        /* (nnz) [1], rows sorted by column */
    Breath *breath;           /* (breaths), in the order of their starts */
    int32_t *first;           /* (n + 1) where each row starts */
    int32_t *column;          /* (nnz) */
    int32_t *triangles;       /* (m, 3) */
    int32_t *sample;          /* (samples) */
    unsigned char *fixed;     /* (n) vertices that do not move */
} Phantom;

/* Reads `path` (UTF-8). Returns NULL and a text in `error` if it cannot be read or is not a valid phantom. */
Phantom *phantom_read(const char *path, char *error, size_t room);
void phantom_free(Phantom *phantom);

#endif
