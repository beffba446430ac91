#include "breath.h"

#include <math.h>

static const double PI = 3.14159265358979323846;

/* The breath of a time, and the time since it began [s]; NULL if there is none. After the last breath comes the first again. */
static const Breath *find(const Phantom *p, double time, double *since) {
    const Breath *first = p->breath, *last;
    int32_t low = 0, high = p->breaths - 1;
    double repeats;
    if (p->breaths < 1) return NULL;
    last = first + high;
    repeats = last->start + last->inspiration + last->expiration + last->pause - first->start;
    time -= repeats * floor((time - first->start) / repeats);
    while (low < high) {
        const int32_t middle = high - (high - low) / 2;
        if (first[middle].start <= time) low = middle;
        else high = middle - 1;
    }
    *since = time - first[low].start;
    return first + low;
}

double breath_excursion(const Phantom *p, double time) {
    double x;
    const Breath *b = find(p, time, &x);
    if (!b) return 0;
    if (x < b->inspiration) return b->amplitude * (1 - cos(PI * x / b->inspiration)) / 2;
    x -= b->inspiration;
    return x < b->expiration ? b->amplitude * (1 + cos(PI * x / b->expiration)) / 2 : 0;
}

double breath_rate(const Phantom *p, double time) {
    double x;
    const Breath *b = find(p, time, &x);
    if (!b) return 0;
    if (x < b->inspiration) return b->amplitude * PI / b->inspiration * sin(PI * x / b->inspiration) / 2;
    x -= b->inspiration;
    return x < b->expiration ? -b->amplitude * PI / b->expiration * sin(PI * x / b->expiration) / 2 : 0;
}

double breath_largest(const Phantom *p) {
    double largest = 0;
    for (int32_t k = 0; k < p->breaths; k++) {
        if (p->breath[k].amplitude > largest) largest = p->breath[k].amplitude;
    }
    return largest;
}
