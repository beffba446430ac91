/* An instance of the FMU, whatever the version of FMI: variables by value reference, states, steps, rollback. */
#ifndef PALPATE_COMPONENT_H
#define PALPATE_COMPONENT_H

#include "flow.h"
#include "surface.h"
#include "tissue.h"

typedef enum { TYPE_REAL, TYPE_INTEGER } Type;
typedef enum { ACCESS_READ, ACCESS_INPUT, ACCESS_FIXED, ACCESS_TUNABLE, ACCESS_STATE } Access;

/* Step mode is that of co-simulation; event and continuous-time mode are those of model exchange. */
typedef enum { PHASE_INSTANTIATED, PHASE_INITIALIZATION, PHASE_STEP, PHASE_EVENT, PHASE_CONTINUOUS, PHASE_TERMINATED } Phase;

/* What has to be brought up to date before a variable is read. */
typedef enum {
    GROUP_NONE, GROUP_MATRICES, GROUP_RATES, GROUP_STATE, GROUP_UNDER, GROUP_ENERGY, GROUP_INWARD, GROUP_SHAPE
} Group;

/* How many values a variable has: a number, or a number behind a pointer, or so many a vertex, branch and vertex, and so on. */
typedef enum { COUNT_PLAIN, COUNT_BEHIND, COUNT_VERTICES, COUNT_BRANCHES, COUNT_TRIANGLES, COUNT_SAMPLES } CountOf;

typedef void (*Log)(void *environment, const char *message);

typedef struct {
    double time;
    double force[3], torque[3];
    double depth;
    double point[3], normal[3];
    double k_w;
    double normal_force, tangential_force;
    double excursion;
    double energy;
    int32_t contacts;
    int32_t unused;
} Outputs;

/* Arrays; some point into the phantom, the tissue or the flow. */
typedef struct {
    double *displacement;      /* (n) */
    double *relaxation;        /* (branches, n) */
    double *stretch;           /* (3) */
    double *activation;        /* (1) */
    double *displacement_rate; /* (n) */
    double *relaxation_rate;   /* (branches, n) */
    double *stretch_rate;      /* (3) */
    double *activation_rate;   /* (1) */
    double *inward;          /* (n) */
    double *position;        /* (n, 3) */
    double *normal;          /* (n, 3) */
    double *rest_position;   /* (n, 3) */
    double *rest_normal;     /* (n, 3) */
    double *stiffness;       /* (n) */
    double *background;      /* (n) */
    double *stiffening;      /* (n) */
    double *tension;         /* (n) */
    int32_t *lesion;         /* (n) */
    int32_t *triangles;      /* (m, 3) */
    double *sample_inward;   /* (samples) */
    double *sample_position; /* (samples, 3) */
} Arrays;

typedef struct Component {
    Phantom *phantom;
    Matrices *matrices;
    Surface *surface;
    Tissue *tissue;
    Flow *flow;
    struct Component *shadow; /* holds a direction and the change along it, where this holds values */
    double *shadow_memory;    /* of its arrays */
    Parameters parameters;
    Inputs inputs;
    Outputs outputs;
    Arrays arrays;
    Phase phase;
    int exchange;      /* whether it is for model exchange; otherwise for co-simulation */
    double stop;       /* [s] */
    int has_stop;
    int stale_matrices;
    unsigned fresh;    /* bit a group that is up to date */
    Log log;
    void *environment;
} Component;

typedef struct {
    uint32_t vr;
    Type type;
    Access access;
    CountOf of;
    int count; /* values, or values a vertex and so on */
    double low, high;
    Group group;
    size_t offset; /* of the value or of a pointer to the array in Component */
    const char *name;
} Row;

/* A place that a value reference stands for. */
typedef struct {
    const Row *row;
    size_t first; /* value within the variable */
    size_t count;
} Slot;

/* A copy of all that a step changes, and of the parameters. */
typedef struct {
    char token[72]; /* of the phantom; the rest is zero */
    Parameters parameters;
    Inputs inputs;
    State state;
    double stop;
    int32_t has_stop;
    int32_t phase;
    int32_t exchange;
    int32_t unused;
    double field[]; /* (1 + BRANCHES, n) */
} Snapshot;

/* Reads the phantom from the FMU's resources; NULL (and a message) if that fails or `token` is not the phantom's. */
Component *component_new(const char *resources, const char *token, int exchange, Log log, void *environment);
void component_free(Component *component);
void component_say(const Component *component, const char *format, ...);

/* All return 1 on success; on failure they have logged why and have changed nothing. */
int component_find(Component *c, uint32_t vr, Type type, int flat, Slot *slot);
int component_read(Component *c, const Slot *slot, void *values);
int component_check(Component *c, const Slot *slot, const void *values);
void component_write(Component *c, const Slot *slot, const void *values);
int component_enter_initialization(Component *c, double start, int has_stop, double stop);
int component_exit_initialization(Component *c);
int component_step(Component *c, double time, double dt);
int component_reset(Component *c);
int component_terminate(Component *c);
int component_expects(Component *c, int phase_is_right, const char *function);

/* Where a component keeps a variable. */
char *component_data(Component *c, const Row *row);

/* outputs.c: brings matrices, or what a group of variables shows, up to date. */
void component_assemble(Component *c);
void component_refresh(Component *c, Group group);

size_t component_snapshot_size(const Component *c);
void component_save(const Component *c, Snapshot *snapshot);
int component_load(Component *c, const Snapshot *snapshot, size_t size);

#endif
