#include "guarding.h"

#include <math.h>

#define GENTLE_DEPTH_M 0.012 /* provokes nothing */
#define DEEP_M 0.025         /* provokes the whole contraction */
#define GENTLE_SPEED_MPS 0.010
#define FAST_MPS 0.050
#define CONTRACTION_S 0.1
#define FADING_S 3.0

static double ramp(double value, double begin, double end) {
    const double share = (value - begin) / (end - begin);
    return share < 0 ? 0 : share > 1 ? 1 : share;
}

double guarding_provoked(Press press) {
    const double by_depth = ramp(press.depth, GENTLE_DEPTH_M, DEEP_M), by_speed = ramp(press.speed, GENTLE_SPEED_MPS, FAST_MPS);
    return by_depth > by_speed ? by_depth : by_speed;
}

double guarding_provoked_along(Press press, Press change) {
    const double provoked = guarding_provoked(press);
    if (provoked <= 0 || provoked >= 1) return 0;
    if (ramp(press.depth, GENTLE_DEPTH_M, DEEP_M) == provoked) return change.depth / (DEEP_M - GENTLE_DEPTH_M);
    return change.speed / (FAST_MPS - GENTLE_SPEED_MPS);
}

double guarding_time(double activation, double provoked) { return provoked > activation ? CONTRACTION_S : FADING_S; }

double guarding_after(double activation, Press press, double dt) {
    const double provoked = guarding_provoked(press);
    return activation + (1 - exp(-dt / guarding_time(activation, provoked))) * (provoked - activation);
}
