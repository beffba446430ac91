/* Model exchange, whatever the version of FMI: time, continuous states, their rates and directional derivatives. */
#ifndef PALPATE_EXCHANGE_H
#define PALPATE_EXCHANGE_H

#include "component.h"

/* All return 1 on success; on failure they have logged why and have changed nothing. */
int exchange_enter(Component *c, Phase phase);
int exchange_ready(Component *c, const char *function);
int exchange_time(Component *c, double time);
int exchange_set_states(Component *c, const double *values, size_t count);
int exchange_get_states(Component *c, double *values, size_t count);
int exchange_rates(Component *c, double *values, size_t count);
int exchange_nominals(Component *c, double *values, size_t count);

/* How `unknowns` (outputs and rates) change along a direction of `knowns` (inputs, states and time): by value references, of
 * elements if `flat`, as arrays otherwise. */
typedef struct {
    int flat;
    const uint32_t *unknowns, *knowns;
    size_t unknown_count, known_count;
    const double *seed;
    size_t seed_size;
    double *sensitivity;
    size_t sensitivity_size;
} Derivative;

int exchange_derive(Component *c, const Derivative *derivative);

#endif
