/* Tones on the nominal plate and on drawn plates. Reference: `model.ensemble.touched_plate.TouchedPlate.drawn`. */
#ifndef DRAWN_H
#define DRAWN_H

#include "fingertips.h"
#include "points.h"

/* Drawn plates, ordered by thickness. The rows of arrays have `width` floats, a register more than there are plates. */
typedef struct {
    int count, bases, nodes, width; /* plates; thicknesses at which changes are computed; thicknesses of plates */
    int first_base, first_node;     /* number of the first of each among the table's thicknesses */
    int amplifiers;                 /* amplifiers with clock errors; 0 without errors */
    const int *node;                /* (count) thickness of each plate */
    const float *loss, *damping;    /* (width) changes per plate */
    const float *own, *gains;       /* (a, width) own stiffness; (2, a, width) gain errors, real and imaginary parts */
    const float *errors;            /* (2, k, width) field errors at fingers, real and imaginary parts */
    const float *harmonics;         /* (2, n, width) second harmonics of ERAs, relative to their motion */
    const float *touches;           /* (2, k, width) displacements of fingers along x and y */
    const float *delays;            /* (amplifiers, width) [s] */
    const int *amplifier;           /* (n) amplifier of each ERA */
} draws;

/* Points under all fingers, and the errors and thresholds by frequency. */
typedef struct {
    int points;
    const float *rows, *weights;     /* (points, r); (points) weight in the mean over the fingertip */
    const float *error, *threshold;  /* (f, n) mean square error per ERA; (f) */
    const float *touch_steps, *disc; /* (k, 3) see `steps_of`, NULL for exact positions of fingers; (points / k, 2) fine
                                      * points in the unit disc */
} sensors;

/* Tones (m) at the points: fields at all thicknesses, and linear changes at a few of them (bases). */
typedef struct {
    const plates *on;
    const draws *by;
    const sensors *at;
    size_t m, padded;
    const int *rows;
    float *error;      /* (m) root mean square error */
    float *at_nodes;   /* (m, 1 + nodes, points) fields, the nominal thickness first */
    float *by_force;   /* (m, bases, 2, a + 1, padded) change of the field per force, and last per loss factor; real
                        * and imaginary parts */
    float *forces;     /* (m, bases, 4, a) forces per loss, damping, own stiffness and gain */
} tones;

INLINE size_t groups_of(const draws *by) { return by->count / by->bases / LANES + (by->count / by->bases % LANES > 0); }

/* Number of groups of LANES plates; the first group is the nominal plate alone. */
INLINE size_t group_count(const draws *by) { return 1 + by->bases * groups_of(by); }

/* Find the first plate of a group, where plate 0 is the nominal one; return the number of plates in the group. */
INLINE size_t plates_of(const draws *by, size_t group, size_t *first) {
    const size_t each = by->count / by->bases, groups = groups_of(by);
    if (!group) return *first = 0, 1;
    const size_t base = (group - 1) / groups, from = (group - 1) % groups * LANES;
    *first = 1 + base * each + from;
    return each - from < LANES ? each - from : LANES;
}

/* Compute the forces of ERAs at weights w, and the resulting accelerations of the fingers (k). */
INLINE void driven(value *forces, value *fingers, const value *drives, const value *w, const touched *of,
                   const plates *on) {
    const size_t n = on->n, b = on->b, k = on->k;
    memset(forces, 0, b * sizeof(value));
    for (size_t e = 0; e < n; e++) forces[e] = times(drives[e], w[e]);
    for (size_t i = 0; i < k; i++) {
        value at = ZERO;
        for (size_t e = 0; e < n; e++) at = add_product(at, of->resting[i * b + e], forces[e]);
        fingers[i] = at;
    }
}

/* Compute the accelerations at the points for each tone and thickness, with weights (m, n). */
SHARED void find_at_nodes(tones *to, const float *weights, arena *memory) {
    const plates *on = to->on;
    const size_t n = on->n, b = on->b, k = on->k, r = on->r, each = 1 + to->by->nodes, points = to->at->points;
    const arena mark = *memory;
    value *space = values(memory, touched_space(on)), *modal = values(memory, r), *held = values(memory, k);
    value *found = values(memory, points), *w = values(memory, n), *drives = values(memory, n);
    value *forces = values(memory, b), *shared = values(memory, b);
    for (size_t first = 0; first < to->m * each; first += LANES) {
        size_t count = to->m * each - first < LANES ? to->m * each - first : LANES;
        int rows[LANES], cases[LANES], given[LANES];
        for (size_t l = 0; l < LANES; l++) {
            size_t at = first + (l < count ? l : count - 1), node = at % each;
            given[l] = at / each, rows[l] = to->rows[given[l]];
            cases[l] = rows[l] * on->t + (node ? to->by->first_node + (int)node - 1 : 0);
        }
        touched of;
        put_fingers(&of, on, rows, cases, space);
        load(drives, on->drives, n, rows);
        load(w, weights, n, given);
        driven(forces, held, drives, w, &of, on);
        for (size_t i = 0; i < k; i++) held[i] = times(of.D[i], held[i]);

        /* Total forces at attachments: of the ERAs, and of the attachments that the fingers move. */
        for (size_t j = 0; j < b; j++) {
            value sum = ZERO;
            for (size_t i = 0; i < k; i++) sum = add_product(sum, held[i], of.at[i * b + j]);
            shared[j] = sum;
        }
        for (size_t j = 0; j < b; j++)
            for (size_t s = 0; s < b; s++) forces[j] = subtract_product(forces[j], of.Y[j * b + s], shared[s]);
        for (size_t s = 0; s < r; s++) {
            value sum = ZERO, own = ZERO;
            for (size_t i = 0; i < k; i++) {
                own.re += held[i].re * on->centers[i * r + s];
                own.im += held[i].im * on->centers[i * r + s];
            }
            for (size_t j = 0; j < b; j++) sum = add_product(sum, forces[j], of.T[j * r + s]);
            modal[s] = subtract_product(sum, own, of.g[s]);
        }
        multiply(found, to->at->rows, modal, points, r, 1);
        store(to->at_nodes + 2 * first * points, found, points, count);
    }
    release(memory, mark);
}

/* Compute the forces (4, a) at attachments and fingers per standard deviation of loss, damping, own stiffness and
 * gain, and the reduced coordinates (r) that the loss factor changes directly. */
INLINE void find_changes(value *forces, value *lost, const touched *of, const plates *on, const int *rows,
                         const int *cases, const value *w, arena *memory) {
    const size_t n = on->n, b = on->b, k = on->k, a = b + k, r = on->r;
    const arena mark = *memory;
    value *drives = values(memory, n), *strokes = values(memory, n), *by_damping = values(memory, n);
    value *by_stiffness = values(memory, on->off), *without = values(memory, b * n), *attached = values(memory, b);
    value *moved = values(memory, a), *held = values(memory, a), *by_loss = values(memory, r);
    value *loss = forces, *damping = loss + a, *own = damping + a, *gains = own + a;
    load(drives, on->drives, n, rows);
    load(strokes, on->strokes, n, rows);
    load(by_damping, on->by_damping, n, rows);
    load(by_stiffness, on->by_stiffness, on->off, rows);
    load(attached, on->attached, b, rows);
    load(without, on->moved, b * n, cases);
    load(by_loss, on->by_loss, r, cases);
    memset(forces, 0, 4 * a * sizeof(value));
    lanes by_motion = inverse(of->minus_omega2);
    driven(gains, moved + b, drives, w, of, on);
    for (size_t i = b; i < a; i++) moved[i] = scaled(moved[i], by_motion);
    for (size_t j = 0; j < b; j++) {
        value sum = ZERO;
        for (size_t i = 0; i < k; i++)
            sum = subtract_product(sum, times(of->at[i * b + j], of->D[i]), moved[b + i]);
        moved[j] = scaled(sum, by_motion);
        for (size_t e = 0; e < n; e++) moved[j] = add_product(moved[j], without[j * n + e], w[e]);
    }
    for (size_t e = 0; e < n; e++) {
        value stretched = subtract_product(times(strokes[e], w[e]), (value){.re = filled(1), .im = ZERO.im}, moved[e]);
        damping[e] = times(by_damping[e], stretched), own[e] = times(by_stiffness[e], stretched);
    }
    for (size_t j = n; j < (size_t)on->off; j++) own[j] = subtract_product(ZERO, by_stiffness[j], moved[j]);
    for (size_t j = 0; j < a; j++) {
        value by = j < b ? attached[j] : of->D[j - b];
        if (j >= b) own[j] = scaled(times(by, moved[j]), filled(-on->load_std[j - b]));
        held[j] = subtract_product(gains[j], by, moved[j]);
    }
    for (size_t s = 0; s < r; s++) {
        value sum = ZERO;
        for (size_t j = 0; j < a; j++) {
            lanes shape = filled(j < b ? on->shapes[j * r + s] : on->centers[(j - b) * r + s]);
            sum.re += held[j].re * shape, sum.im += held[j].im * shape;
        }
        lost[s] = times(by_loss[s], sum);
    }
    for (size_t j = 0; j < a; j++) {
        const float *shape = j < b ? on->shapes + j * r : on->centers + (j - b) * r;
        value sum = ZERO, by = j < b ? attached[j] : of->D[j - b];
        for (size_t s = 0; s < r; s++) sum.re += lost[s].re * shape[s], sum.im += lost[s].im * shape[s];
        loss[j] = subtract_product(ZERO, by, sum);
    }
    for (size_t s = 0; s < r; s++) lost[s] = scaled(lost[s], of->minus_omega2);
    release(memory, mark);
}

/* Compute the changes of tones with weights (m, n). columns: from `columns_of`. */
SHARED void find_by_force(tones *to, const float *columns, const float *weights, arena *memory) {
    const plates *on = to->on;
    const size_t n = on->n, a = on->b + on->k, r = on->r, bases = to->by->bases, cases_in_all = to->m * bases;
    const size_t each = 2 * (a + 1) * to->padded;
    const arena mark = *memory;
    value *space = values(memory, touched_space(on)), *lost = values(memory, r), *forces = values(memory, 4 * a);
    value *w = values(memory, n);
    float *by_loss = floats(memory, 2 * LANES * r);
    for (size_t first = 0; first < cases_in_all; first += LANES) {
        size_t count = cases_in_all - first < LANES ? cases_in_all - first : LANES;
        int rows[LANES], cases[LANES], given[LANES];
        for (size_t l = 0; l < LANES; l++) {
            size_t at = first + (l < count ? l : count - 1);
            given[l] = at / bases, rows[l] = to->rows[given[l]];
            cases[l] = rows[l] * on->t + to->by->first_base + (int)(at % bases);
        }
        touched of;
        float *found = to->by_force + each * first;
        put_fingers_at_points(&of, found, each, on, rows, cases, count, columns, to->padded, to->at->points, space, memory);
        load(w, weights, n, given);
        find_changes(forces, lost, &of, on, rows, cases, w, memory);
        store(to->forces + 2 * 4 * a * first, forces, 4 * a, count);
        store(by_loss, lost, r, count);
        at_points(found + 2 * a * to->padded, each, by_loss, count, columns, to->padded, r);
    }
    release(memory, mark);
}

/* Return the fields and changes of tones at rows (m) with weights (m, n). */
SHARED tones respond(const plates *on, const draws *by, const sensors *at, const float *columns, size_t m,
                     const int *rows, const float *weights, arena *memory) {
    const size_t n = on->n, a = on->b + on->k, padded = padded_to(at->points + on->k), cases = m * by->bases;
    tones found = {.on = on, .by = by, .at = at, .m = m, .padded = padded, .rows = rows, .error = floats(memory, m),
                   .at_nodes = floats(memory, 2 * m * (1 + by->nodes) * at->points),
                   .by_force = floats(memory, 2 * cases * (a + 1) * padded),
                   .forces = floats(memory, 2 * 4 * cases * a)};
    for (size_t tone = 0; tone < m; tone++) {
        float sum = 0;
        for (size_t e = 0; e < n; e++) {
            const float *w = weights + 2 * (tone * n + e);
            sum += at->error[rows[tone] * n + e] * (w[0] * w[0] + w[1] * w[1]);
        }
        found.error[tone] = sqrtf(sum);
    }
    find_at_nodes(&found, weights, memory);
    find_by_force(&found, columns, weights, memory);
    return found;
}

/* exp(-i phase). */
INLINE value late_by(lanes phase) {
    const lanes turns = phase * 0.15915494f, rounder = filled(12582912);
    const lanes x = (turns - (turns + rounder - rounder)) * 1.5707963f, s = x * x; /* a quarter of the phase */
    const lanes cosine = 1 + s * (-1 / 2.f + s * (1 / 24.f + s * (-1 / 720.f + s * (1 / 40320.f))));
    const lanes sine = x * (1 + s * (-1 / 6.f + s * (1 / 120.f + s * (-1 / 5040.f + s * (1 / 362880.f)))));
    const value quarter = {.re = cosine, .im = -sine}, half = times(quarter, quarter);
    return times(half, half);
}

/* Change of the field at a finger's fine points by its displacement: of the mean, and per radius along x and along y. */
typedef struct {
    value mean, along_x, along_y;
} moved;

/* Displace a finger by x and y standard deviations. The change follows from a quadratic polynomial through some of its
 * points; from a gradient for a disc that an edge cuts. steps (3): see `steps_of`. */
INLINE moved displaced(const value *field, const float *steps, lanes x, lanes y) {
    const value center = field[0], west = field[FINE_ENDS[0][0]], east = field[FINE_ENDS[0][1]];
    const value south = field[FINE_ENDS[1][0]], north = field[FINE_ENDS[1][1]], *first = field + FINE_DIAGONAL[0];
    const value *second = field + FINE_DIAGONAL[1], *third = field + FINE_DIAGONAL[2], *fourth = field + FINE_DIAGONAL[3];
    const value by_xx = {.re = east.re + west.re - 2 * center.re, .im = east.im + west.im - 2 * center.im};
    const value by_yy = {.re = north.re + south.re - 2 * center.re, .im = north.im + south.im - 2 * center.im};
    const value by_xy = {.re = first->re - second->re + third->re - fourth->re,
                         .im = first->im - second->im + third->im - fourth->im};
    x *= steps[0], y *= steps[1];
    moved by = {.mean = {.re = x * (east.re - west.re) + y * (north.re - south.re),
                         .im = x * (east.im - west.im) + y * (north.im - south.im)}};
    x *= 2 * steps[2], y *= 2 * steps[2]; /* in radii */
    by.along_x = (value){.re = x * by_xx.re + y * by_xy.re, .im = x * by_xx.im + y * by_xy.im};
    by.along_y = (value){.re = x * by_xy.re + y * by_yy.re, .im = x * by_xy.im + y * by_yy.im};
    by.mean.re += 0.5f * (x * by.along_x.re + y * by.along_y.re);
    by.mean.im += 0.5f * (x * by.along_x.im + y * by.along_y.im);
    return by;
}

/* Compute sensed (points): squared amplitudes of a tone relative to the threshold, on a group of plates. */
SHARED void sense(lanes *sensed, const tones *of, size_t tone, size_t group, value *found, value *force) {
    const draws *by = of->by;
    const size_t a = of->on->b + of->on->k, points = of->at->points, k = of->on->k, width = by->width, padded = of->padded;
    const size_t each = points / k, nodes = tone * (1 + by->nodes);
    const float threshold = of->at->threshold[of->rows[tone]], above = 1 / (threshold * threshold);
    size_t first, count = plates_of(by, group, &first);
    int rows[LANES];
    for (size_t l = 0; l < LANES; l++)
        rows[l] = nodes + (group ? 1 + by->node[first - 1 + (l < count ? l : 0)] : 0);
    load(found, of->at_nodes, points, rows);
    if (!group) {
        for (size_t i = 0; i < points; i++) sensed[i] = above * power(found[i]);
        return;
    }
    const size_t from = first - 1, base = tone * by->bases + (group - 1) / groups_of(by);
    const float *loss = of->forces + 2 * 4 * a * base, *damping = loss + 2 * a, *own = damping + 2 * a, *gain = own + 2 * a;
    const float *T = of->by_force + 2 * (a + 1) * padded * base;
    const float omega = sqrtf(-of->on->minus_omega2[of->rows[tone]]);
    value late[1 + by->amplifiers];
    for (int i = 0; i < by->amplifiers; i++) late[i] = late_by(omega * some(by->delays + i * width + from));
    lanes by_loss = some(by->loss + from), by_damping = some(by->damping + from);
    for (size_t j = 0; j < a; j++) {
        lanes by_own = some(by->own + j * width + from);
        lanes re = some(by->gains + j * width + from), im = some(by->gains + (a + j) * width + from);
        if (by->amplifiers && j < (size_t)of->on->n) {
            const value found = times((value){.re = 1 + re, .im = im}, late[by->amplifier[j]]);
            re = found.re - 1, im = found.im;
        }
        force[j].re = loss[2 * j] * by_loss + damping[2 * j] * by_damping + own[2 * j] * by_own + gain[2 * j] * re -
                      gain[2 * j + 1] * im;
        force[j].im = loss[2 * j + 1] * by_loss + damping[2 * j + 1] * by_damping + own[2 * j + 1] * by_own +
                      gain[2 * j] * im + gain[2 * j + 1] * re;
    }
    force[a] = (value){.re = by_loss, .im = ZERO.im};
    for (size_t i = 0; i < points; i += 4) {
        const size_t last = points - 1 - i; /* padded points are read but not stored */
        value s0 = found[i], s1 = found[i + (last > 0)], s2 = found[i + (last > 1 ? 2 : 0)], s3 = found[i + (last > 2 ? 3 : 0)];
        for (size_t j = 0; j <= a; j++) {
            value f = force[j];
            const float *re = T + 2 * j * padded + i, *im = re + padded;
            s0 = add_scaled(s0, f, re[0], im[0]);
            s1 = add_scaled(s1, f, re[1], im[1]);
            s2 = add_scaled(s2, f, re[2], im[2]);
            s3 = add_scaled(s3, f, re[3], im[3]);
        }
        found[i] = s0;
        if (last > 0) found[i + 1] = s1;
        if (last > 1) found[i + 2] = s2;
        if (last > 2) found[i + 3] = s3;
    }
    for (size_t finger = 0; finger < k; finger++) {
        lanes re = of->error[tone] * some(by->errors + finger * width + from);
        lanes im = of->error[tone] * some(by->errors + (k + finger) * width + from);
        if (!of->at->touch_steps) {
            for (size_t i = finger * each; i < (finger + 1) * each; i++)
                sensed[i] = above * power((value){.re = found[i].re + re, .im = found[i].im + im});
            continue;
        }
        const moved by_touch = displaced(found + finger * each, of->at->touch_steps + 3 * finger,
                                         some(by->touches + finger * width + from),
                                         some(by->touches + (k + finger) * width + from));
        re += by_touch.mean.re, im += by_touch.mean.im;
        for (size_t i = finger * each, point = 0; point < each; i++, point++) {
            const float x = of->at->disc[2 * point], y = of->at->disc[2 * point + 1];
            sensed[i] = above * power((value){.re = found[i].re + re + x * by_touch.along_x.re + y * by_touch.along_y.re,
                                              .im = found[i].im + im + x * by_touch.along_x.im + y * by_touch.along_y.im});
        }
    }
}

#endif
