#include "flow.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* A sphere is followed to this depth below the rest surface, whatever path it took: rates depend on the states alone. */
#define DEEPEST_M 0.1

size_t flow_states(const Phantom *p) { return (1 + (size_t)p->branches) * (size_t)p->n + 4; }

Flow *flow_new(const Tissue *tissue) {
    const size_t n = (size_t)tissue->phantom->n;
    Flow *f = calloc(1, sizeof *f);
    if (!f) return NULL;
    f->tissue = tissue;
    f->rate = calloc(flow_states(tissue->phantom), sizeof(double));
    f->strain = calloc(n, sizeof(double));
    f->gap = calloc(n, sizeof(double));
    if (!candidates_new(&f->near, n) || !f->rate || !f->strain || !f->gap) {
        flow_free(f);
        return NULL;
    }
    return f;
}

void flow_free(Flow *f) {
    if (!f) return;
    free(f->rate);
    free(f->strain);
    free(f->gap);
    candidates_free(&f->near);
    free(f);
}

void flow_forget(Flow *f) { f->radius = 0; }

static void gather(Flow *f, const double *p) {
    const Tissue *t = f->tissue;
    const double radius = t->parameters.radius;
    if (f->radius == radius && memcmp(f->at, p, sizeof f->at) == 0) return;
    candidates_collect(&f->near, t->phantom, t->matrices, p, radius,
                       sqrt(radius * radius + DEEPEST_M * DEEPEST_M) + tissue_largest_excursion(t));
    memcpy(f->at, p, sizeof f->at);
    f->radius = radius;
}

/* How fast springs, dashpots and Maxwell branches move by themselves; y' is linear in (u, y) alone. */
static void relax(const Tissue *t, const double *field, const double *strain, double *rate) {
    const int32_t n = t->phantom->n;
    for (int32_t i = 0; i < n; i++) rate[i] = -matrices_row(t->matrices, t->matrices->relative, strain, i);
    for (int32_t k = 0; k < t->phantom->branches; k++) {
        const size_t at = (size_t)(k + 1) * (size_t)n;
        const double g = t->parameters.prony_g[k], tau = t->parameters.prony_tau[k];
        for (int32_t i = 0; i < n; i++) rate[at + (size_t)i] = (g * field[i] - field[at + (size_t)i]) / tau;
    }
}

/* The bristle follows the sphere across the normal; what friction does not carry decays. */
static void rub(Flow *f, const Inputs *in, double *rate) {
    const Tissue *t = f->tissue;
    const double *push = f->grip.push, *s = t->state.stretch;
    const double load = sqrt(push[0] * push[0] + push[1] * push[1] + push[2] * push[2]);
    const double limit = t->parameters.friction * load, stiffness = contact_skin_stiffness(t->phantom, &t->parameters);
    double held[3] = {0, 0, 0}, v[3] = {0, 0, 0}, along = 0;
    if (limit > 0) {
        memcpy(held, s, sizeof held);
        contact_stick(push, limit, stiffness, held);
        contact_pull(stiffness, held, f->grip.point, f->force, f->torque);
        contact_slip(in, f->grip.point, v);
        for (int k = 0; k < 3; k++) along += v[k] * (push[k] / load);
        for (int k = 0; k < 3; k++) v[k] -= along * (push[k] / load);
    }
    for (int k = 0; k < 3; k++) rate[k] = v[k] - (s[k] - held[k]) / t->parameters.contact_time;
}

/* How fast muscle contracts under the sphere [1/s]. */
static double contract(const Flow *f, const Inputs *in) {
    const Tissue *t = f->tissue;
    double provoked;
    if (!t->parameters.voluntary || f->deepest < 0) return 0;
    provoked = guarding_provoked(tissue_press(t, in, f->deepest));
    return (provoked - t->state.activation) / guarding_time(t->state.activation, provoked);
}

void flow_evaluate(Flow *f, const Inputs *in) {
    const Tissue *t = f->tissue;
    const double T = t->parameters.contact_time;
    Hold hold;
    gather(f, in->position);
    tissue_strain(t, f->strain);
    relax(t, t->field, f->strain, f->rate);
    for (int32_t i = 0; i < t->phantom->n; i++) f->rate[i] -= tissue_stiffening(t, i) / t->parameters.dashpot;
    memset(&f->grip, 0, sizeof f->grip);
    f->deepest = -1;
    memset(f->force, 0, sizeof f->force);
    memset(f->torque, 0, sizeof f->torque);
    for (int32_t k = 0; k < f->near.count; k++) {
        const int32_t i = f->near.index[k];
        double gap;
        f->gap[k] = 0;
        if (!contact_hold(&f->near, k, in->position, t->parameters.radius, &hold)) continue;
        gap = hold.hold + t->state.excursion * f->near.breathing[k] - (t->field[i] + T * f->rate[i]);
        if (gap <= 0) continue;
        f->gap[k] = gap;
        f->rate[i] += gap / T;
        if (f->deepest < 0 || t->field[i] > t->field[f->deepest]) f->deepest = i;
        contact_add(&f->grip, f->near.normals + 3 * k, &hold, gap * (f->near.damping[k] / T));
    }
    for (int k = 0; k < 3 && f->grip.count; k++) {
        f->force[k] = f->grip.push[k] + f->grip.side[k];
        f->grip.point[k] /= f->grip.load;
    }
    rub(f, in, f->rate + flow_states(t->phantom) - 4);
    f->rate[flow_states(t->phantom) - 1] = contract(f, in);
}

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void add_cross(const double *a, const double *b, double *out) {
    out[0] += a[1] * b[2] - a[2] * b[1];
    out[1] += a[2] * b[0] - a[0] * b[2];
    out[2] += a[0] * b[1] - a[1] * b[0];
}

/* A vector across the unit vector e, and how it changes with both: v - e (e.v). */
static void project(const double *e, const double *de, double *v, double *dv) {
    const double along = dot(e, v), change = dot(de, v) + dot(e, dv);
    for (int k = 0; k < 3; k++) {
        v[k] -= e[k] * along;
        dv[k] -= de[k] * along + e[k] * change;
    }
}

/* The derivative of `rub`. */
static void rub_along(const Flow *f, const Inputs *in, const Direction *along, const double *dpush, const double *dpoint,
                      Change *change) {
    const Tissue *t = f->tissue;
    const double *push = f->grip.push, *r = f->grip.point;
    const double load = sqrt(dot(push, push)), mu = t->parameters.friction, T = t->parameters.contact_time;
    const double stiffness = contact_skin_stiffness(t->phantom, &t->parameters);
    double e[3], de[3], v[3], dv[3], held[3] = {0, 0, 0}, dheld[3] = {0, 0, 0}, pull[3], dpull[3];
    double *rate = change->rate + flow_states(t->phantom) - 4;
    memset(dv, 0, sizeof dv);
    if (mu * load > 0) {
        const double dload = dot(push, dpush) / load;
        double length;
        for (int k = 0; k < 3; k++) {
            e[k] = push[k] / load;
            de[k] = (dpush[k] - e[k] * dload) / load;
            held[k] = t->state.stretch[k];
            dheld[k] = along->stretch[k];
            dv[k] = along->inputs.velocity[k];
        }
        contact_slip(in, r, v);
        add_cross(along->inputs.spin, r, dv);
        add_cross(in->spin, dpoint, dv);
        project(e, de, v, dv);
        project(e, de, held, dheld);
        length = sqrt(dot(held, held));
        if (stiffness * length > mu * load) { /* it slides */
            const double share = mu * load / (stiffness * length);
            const double dshare = share * (dload / load - dot(held, dheld) / (length * length));
            for (int k = 0; k < 3; k++) {
                dheld[k] = share * dheld[k] + dshare * held[k];
                held[k] *= share;
            }
        }
        for (int k = 0; k < 3; k++) {
            pull[k] = -stiffness * held[k];
            dpull[k] = -stiffness * dheld[k];
            change->force[k] += dpull[k];
        }
        add_cross(dpoint, pull, change->torque);
        add_cross(r, dpull, change->torque);
    }
    for (int k = 0; k < 3; k++) rate[k] = dv[k] - (along->stretch[k] - dheld[k]) / T;
}

/* The derivative of `contract`. */
static double contract_along(const Flow *f, const Inputs *in, const Direction *along) {
    const Tissue *t = f->tissue;
    Press press, change;
    if (!t->parameters.voluntary || f->deepest < 0) return 0;
    press = tissue_press(t, in, f->deepest);
    change.depth = along->field[f->deepest];
    change.speed = -dot(along->inputs.velocity, t->phantom->normals + 3 * f->deepest);
    return (guarding_provoked_along(press, change) - along->activation) /
           guarding_time(t->state.activation, guarding_provoked(press));
}

void flow_derive(const Flow *f, const Inputs *in, const Direction *along, Change *change) {
    const Tissue *t = f->tissue;
    const Parameters *par = &t->parameters;
    const double T = par->contact_time, *dp = along->inputs.position;
    const int32_t n = t->phantom->n;
    double dpush[3] = {0, 0, 0}, dpoint[3] = {0, 0, 0}, dload = 0;
    Hold hold;
    change->excursion = tissue_excursion_rate(t, t->state.time) * along->time;
    memset(change->force, 0, sizeof change->force);
    memset(change->torque, 0, sizeof change->torque);
    memcpy(f->strain, along->field, (size_t)n * sizeof(double));
    for (int32_t k = 0; k < t->phantom->branches; k++) {
        const double *dy = along->field + (size_t)(k + 1) * (size_t)n;
        if (par->prony_g[k] <= 0) continue;
        for (int32_t i = 0; i < n; i++) f->strain[i] -= dy[i];
    }
    relax(t, along->field, f->strain, change->rate);
    for (int32_t i = 0; i < n; i++) {
        change->rate[i] -= tissue_stiffening_along(t, i, along->field[i], along->activation) / par->dashpot;
    }
    for (int32_t k = 0; k < f->near.count; k++) {
        const int32_t i = f->near.index[k];
        const double *normal = f->near.normals + 3 * k, *x = hold.x, damping = f->near.damping[k];
        double dbelow, dhalf, dgap, force, dforce, dsteep;
        if (f->gap[k] <= 0 || !contact_hold(&f->near, k, in->position, par->radius, &hold)) continue;
        dbelow = -dot(normal, dp);
        dhalf = (dot(x, dp) + hold.below * dbelow) / hold.half;
        dgap = dbelow + dhalf + change->excursion * f->near.breathing[k] - along->field[i] - T * change->rate[i];
        change->rate[i] += dgap / T;
        force = f->gap[k] * damping / T, dforce = dgap * damping / T;
        dsteep = (dforce - force * dhalf / hold.half) / hold.half;
        dload += dforce;
        for (int j = 0; j < 3; j++) {
            const double arm = x[j] - hold.hold * normal[j], slope = hold.below * normal[j] - x[j];
            dpush[j] += dforce * normal[j];
            change->force[j] += dsteep * slope + force / hold.half * (dbelow * normal[j] + dp[j]);
            dpoint[j] += dforce * arm - force * (dp[j] + (dbelow + dhalf) * normal[j]);
        }
    }
    for (int j = 0; j < 3 && f->grip.count; j++) {
        change->force[j] += dpush[j];
        dpoint[j] = (dpoint[j] - f->grip.point[j] * dload) / f->grip.load;
    }
    rub_along(f, in, along, dpush, dpoint, change);
    change->rate[flow_states(t->phantom) - 1] = contract_along(f, in, along);
}
