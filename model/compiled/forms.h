/* Expected powers at groups of points. Reference: `model.ensemble.touched_plate.TouchedPlate.forms`. */
#ifndef FORMS_H
#define FORMS_H

#include "arena.h"
#include "fingers.h"
#include "fingertips.h"

typedef struct {
    int groups, p, fine;       /* groups of points; points per group; fine points of all groups */
    int others;                /* whether the plate's thickness is uncertain */
    float gain_variance, ridge;
    const float *points, *fine_points, *weights; /* (groups p, r); (fine, r); (groups p) */
    const float *error;        /* (f, n) */
    const float *shares;       /* (f, n, n) relative increase of the power of h by clock errors; NULL without errors */
    const char *is_fine;       /* (k) whether fine points of a finger are needed; NULL for all fingers */
    const float *touch_steps;  /* (k, 3) see `steps_of`; NULL for exact positions of fingers, or points other than the few */
    int rim;                   /* first of a finger's fine points that are needed, apart from its point 0 */
} grouped;

/* Results at LANES frequencies: fields h (groups p, n) and at fine points (fine, n); forms R (groups, n, n), and R
 * without the nominal part. */
typedef struct {
    value *fields, *fine, *power, *uncertain;
} formed;

SHARED formed new_forms(const plates *on, const grouped *of, arena *memory) {
    const size_t n = on->n, groups = of->groups;
    return (formed){.fields = values(memory, groups * of->p * n), .fine = values(memory, of->fine * n),
                    .power = values(memory, groups * n * n), .uncertain = values(memory, groups * n * n)};
}

/* Multiply accelerations per force (p, n) by the force of each ERA. */
INLINE void drive(value *h, const value *drives, size_t p, size_t n) {
    for (size_t i = 0; i < p; i++)
        for (size_t e = 0; e < n; e++) h[i * n + e] = times(h[i * n + e], drives[e]);
}

/* Compute fields and forms at rows (LANES). */
SHARED void find_forms(formed *to, const plates *on, const grouped *of, const int *rows, arena *memory) {
    const size_t n = on->n, b = on->b, k = on->k, a = b + k, off = on->off, j = off + k;
    const size_t p = of->p, groups = of->groups, at = groups * p, each = at % k ? at : at / k; /* points per finger */
    const int parts = of->others ? 4 : 2;
    const arena mark = *memory;
    int cases[LANES];
    for (int l = 0; l < LANES; l++) cases[l] = rows[l] * on->t;
    touched now;
    const size_t points = (size_t)of->fine > at ? (size_t)of->fine : at;
    value *space = values(memory, touched_space(on)), *room = values(memory, points * a);
    value *t = values(memory, at * a), *h = values(memory, parts * at * n), *fine = to->fine;
    value *moved = values(memory, a * n), *without = values(memory, b * n), *drives = values(memory, n);
    value *strokes = values(memory, n), *by_damping = values(memory, n), *by_stiffness = values(memory, off);
    value *damped = values(memory, n * n), *changes = values(memory, j * n);
    value *X = values(memory, (parts * p + j + 2 * k) * n), *R = to->power, *U = to->uncertain;
    value *modeled = values(memory, n * n);
    lanes *error = take(memory, n * sizeof(lanes)), *shares = take(memory, n * n * sizeof(lanes));
    put_fingers(&now, on, rows, cases, space);
    load(drives, on->drives, n, rows);
    load(strokes, on->strokes, n, rows);
    load(by_damping, on->by_damping, n, rows);
    load(by_stiffness, on->by_stiffness, off, rows);
    load(without, on->moved, b * n, cases);
    load_real(error, of->error, n, rows);
    if (of->shares) load_real(shares, of->shares, n * n, rows);

    /* Fields t per force at an attachment, fields h per ERA, and their change with the damping. */
    to_points(t, a, of->points, at, each, &now, on, room);
    for (size_t i = 0; i < at; i++)
        for (size_t e = 0; e < n; e++) h[i * n + e] = times(t[i * a + e], drives[e]);
    const size_t fingers = of->fine % k ? 1 : k, fine_each = of->fine / fingers;
    for (size_t finger = 0; of->fine && finger < fingers; finger++) {
        if (of->is_fine && !of->is_fine[finger]) continue;
        for (size_t part = 0; part < 2; part++) { /* point 0, then the points from `rim` on */
            const size_t first = finger * fine_each + (part ? of->rim : 0);
            const size_t count = part ? fine_each - of->rim : of->rim > 0;
            value *found = fine + first * n;
            to_points(found, n, of->fine_points + first * on->r, count, count, &now, on, room);
            drive(found, drives, count, n);
        }
    }
    memcpy(to->fields, h, at * n * sizeof(value));
    with_fingers_moved(moved, without, &now, drives, on);
    for (size_t i = 0; i < off; i++) {
        for (size_t e = 0; e < n; e++) {
            value own = scaled(moved[i * n + e], filled(-1));
            if (i == e) own = (value){.re = own.re + strokes[e].re, .im = own.im + strokes[e].im};
            if (i < n) damped[i * n + e] = times(by_damping[i], own);
            changes[i * n + e] = times(by_stiffness[i], own);
        }
    }
    for (size_t i = 0; i < k; i++)
        for (size_t e = 0; e < n; e++)
            changes[(off + i) * n + e] =
                scaled(times(now.D[i], moved[(b + i) * n + e]), filled(on->load_std[i]));
    product(h + at * n, t, a, damped, at, n, n);

    /* Change of the fields on a thicker and on a thinner plate, with half the weight each. */
    for (int part = 2; part < parts; part++) {
        for (int l = 0; l < LANES; l++) cases[l] = rows[l] * on->t + part - 1;
        put_fingers(&now, on, rows, cases, space);
        for (size_t first = 0; first < at; first += each) {
            value *other = h + (part * at + first) * n;
            float weight = 0;
            for (size_t i = first; i < first + each; i++) weight += of->weights[i];
            if (weight == 0) continue;
            to_points(other, n, of->points + first * on->r, each, each, &now, on, room);
            drive(other, drives, each, n);
            for (size_t i = 0; i < each * n; i++) {
                const value own = h[first * n + i];
                other[i] = scaled((value){.re = other[i].re - own.re, .im = other[i].im - own.im}, filled(sqrtf(0.5f)));
            }
        }
    }

    /* Form of each group: nominal fields at its points, plus all uncertain contributions. */
    for (size_t group = 0; group < groups; group++) {
        value *form = R + group * n * n, *to = X;
        size_t counted = 0;
        for (int part = 0; part < parts; part++)
            for (size_t i = group * p; i < (group + 1) * p; i++) {
                if (of->weights[i] == 0) continue;
                if (!part) counted++;
                lanes share = filled(sqrtf(of->weights[i]));
                for (size_t e = 0; e < n; e++) *to++ = scaled(h[(part * at + i) * n + e], share);
            }
        for (size_t s = 0; s < j; s++) {
            lanes share = {0};
            for (size_t i = group * p; i < (group + 1) * p; i++)
                share += of->weights[i] * power(t[i * a + (s < off ? s : b + s - off)]);
            share = root(share);
            for (size_t e = 0; e < n; e++) *to++ = scaled(changes[s * n + e], share);
        }
        for (size_t first = group * p; of->touch_steps && first < (group + 1) * p; first += each) {
            float share = 0;
            for (size_t i = first; i < first + each; i++) share += of->weights[i];
            for (int axis = 0; share != 0 && axis < 2; axis++) {
                const value *low = h + (first + FEW_ENDS[axis][0]) * n, *high = h + (first + FEW_ENDS[axis][1]) * n;
                const lanes step = filled(sqrtf(share) * of->touch_steps[3 * (first / each) + axis]);
                for (size_t e = 0; e < n; e++)
                    *to++ = scaled((value){.re = high[e].re - low[e].re, .im = high[e].im - low[e].im}, step);
            }
        }
        gram(modeled, X, counted, n);
        gram(form, X + counted * n, (size_t)(to - X) / n - counted, n);
        for (size_t u = 0; u < n; u++)
            for (size_t v = u; v < n; v++) {
                form[u * n + v].re += modeled[u * n + v].re;
                form[u * n + v].im += modeled[u * n + v].im;
            }
        for (size_t u = 0; of->shares && u < n; u++) /* clock errors of amplifiers */
            for (size_t v = u; v < n; v++) {
                form[u * n + v].re += shares[u * n + v] * modeled[u * n + v].re;
                form[u * n + v].im += shares[u * n + v] * modeled[u * n + v].im;
            }
        lanes trace = {0};
        for (size_t e = 0; e < n; e++) {
            lanes size = {0};
            for (size_t i = group * p; i < (group + 1) * p; i++)
                size += of->weights[i] * power(h[i * n + e]);
            form[e * n + e].re += of->gain_variance * size + error[e];
            trace += form[e * n + e].re;
        }
        for (size_t e = 0; e < n; e++) {
            form[e * n + e] = (value){.re = form[e * n + e].re + trace * (of->ridge / (float)n), .im = ZERO.im};
            for (size_t v = 0; v < e; v++)
                form[e * n + v] = (value){.re = form[v * n + e].re, .im = -form[v * n + e].im};
        }
        value *rest = U + group * n * n;
        for (size_t u = 0; u < n; u++)
            for (size_t v = u; v < n; v++) {
                value own = form[u * n + v], without = modeled[u * n + v];
                rest[u * n + v] = (value){.re = own.re - without.re, .im = own.im - without.im};
                rest[v * n + u] = (value){.re = own.re - without.re, .im = without.im - own.im};
            }
        for (size_t u = 0; u < n; u++) rest[u * n + u].im = ZERO.im;
    }
    release(memory, mark);
}

#endif
