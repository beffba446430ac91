/* The tissue as an ordinary differential equation, for model exchange, and its derivative. See the README for the equations. */
#ifndef PALPATE_FLOW_H
#define PALPATE_FLOW_H

#include "tissue.h"

/* Continuous states: u (n), y_k (branches, n), stretch (3), activation. Their rates lie in this order. */
typedef struct {
    const Tissue *tissue;
    double *rate;   /* (states) [m/s], the last [1/s] */
    double *strain; /* (n), scratch */
    Candidates near;
    double *gap;   /* (near.count) how far a vertex is moved to the sphere; 0: it is not [m] */
    double at[3];  /* for which they were gathered [m] */
    double radius; /* [m]; 0: none gathered yet */
    Grip grip;
    int32_t deepest; /* of the vertices that are moved to the sphere; -1: none */
    double force[3]; /* on the sphere [N] */
    double torque[3];
} Flow;

/* A direction in which time, inputs and states change. */
typedef struct {
    double time;
    Inputs inputs;
    const double *field; /* as that of the tissue: (1 + branches, n) */
    double stretch[3];
    double activation;
} Direction;

/* What changes with it. */
typedef struct {
    double excursion;
    double *rate; /* (states) */
    double force[3], torque[3];
} Change;

Flow *flow_new(const Tissue *tissue);
void flow_free(Flow *flow);

/* After the matrices changed. */
void flow_forget(Flow *flow);

/* How many continuous states there are. */
size_t flow_states(const Phantom *phantom);

/* Rates and wrench for the tissue's state and these inputs. */
void flow_evaluate(Flow *flow, const Inputs *inputs);

/* The derivative of what `flow_evaluate` gave last, for the same state and inputs, along a direction. */
void flow_derive(const Flow *flow, const Inputs *inputs, const Direction *along, Change *change);

#endif
