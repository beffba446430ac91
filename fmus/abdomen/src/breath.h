/* The breaths of a phantom: how far its wall is lifted, as palpate_models.patient.breathing draws them. */
#ifndef PALPATE_BREATH_H
#define PALPATE_BREATH_H

#include "phantom.h"

/* Excursion [m] at a time [s], outward positive, where the breathing profile is 1. */
double breath_excursion(const Phantom *phantom, double time);

/* How fast it changes [m/s]. */
double breath_rate(const Phantom *phantom, double time);

/* Largest excursion [m] there is. */
double breath_largest(const Phantom *phantom);

#endif
