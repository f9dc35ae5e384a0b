/* Fingers on the plate. Reference, also for the symbols: `model.ensemble.touched_plate`. */
#ifndef FINGERS_H
#define FINGERS_H

#include "lanes.h"

typedef struct {
    int n, b, k, r, t;          /* ERAs; attachments (ERAs and masses); fingers; reduced coordinates; thicknesses */
    int off;                    /* ERAs, and masses up to the last foot with uncertain stiffness */
    int rows, lanes, kept;      /* frequencies; lanes and thicknesses of the blocks below */
    const float *receptance, *by_force, *coupling, *moved; /* (f, t, ...) g (r), T (b, r), Y (b, b), (b, n) */
    const float *minus_omega2, *drives, *strokes;          /* (f), (f, n), (f, n) */
    const float *by_damping, *by_stiffness;                /* (f, n), (f, off) */
    const float *by_loss, *attached, *shapes;              /* (f, t, r); (f, b) Z; (b, r) */
    const float *centers, *stiffness, *load_std;           /* (k, r); (f, k) D; (k) standard deviation of its logarithm */
    value *of_blocks; /* (blocks of LANES frequencies, first thicknesses, b, r) T, as loaded by `load` */
} plates;

/* LANES cases (a frequency and a thickness each) with the fingers on the plate. */
typedef struct {
    const value *T;          /* (b, r) */
    value *g, *Y;            /* (r), (b, b) */
    value *at;               /* (k, b) accelerations at the fingers per force at an attachment, without the fingers'
                              * load */
    value *resting, *P, *D;  /* (k, b) the same with the fingers' load; (k, k) (1 + G D)^-1; (k) */
    value *G;                /* (k, k) displacement at the fingers per force at a finger, without the fingers' load */
    value *through;          /* (b, k) Y at^T */
    value *held, *forced;    /* (k, b) -D resting; (k, k) -w² P^T: factors on G in the fields that the fingers add */
    value *row;              /* work space (b + k + r) */
    lanes minus_omega2;
} touched;

INLINE size_t touched_space(const plates *on) {
    size_t b = on->b, k = on->k, r = on->r;
    return b * r + r + b * b + 4 * k * b + 3 * k * k + k + b + k + r;
}

/* Replace P = G by (1 + G D)^-1. Elimination without pivoting is stable, because fingers and plate only dissipate
 * energy. */
INLINE void invert(value *restrict P, const value *D, size_t k) {
    for (size_t i = 0; i < k; i++) {
        for (size_t j = 0; j < k; j++) P[i * k + j] = times(P[i * k + j], D[j]);
        P[i * k + i].re += 1;
    }
    for (size_t s = 0; s < k; s++) {
        value *own = P + s * k, factor = reciprocal(own[s]);
        own[s] = (value){.re = filled(1), .im = ZERO.im};
        for (size_t j = 0; j < k; j++) own[j] = times(own[j], factor);
        for (size_t i = 0; i < k; i++) {
            if (i == s) continue;
            value by = P[i * k + s];
            P[i * k + s] = ZERO;
            for (size_t j = 0; j < k; j++) P[i * k + j] = subtract_product(P[i * k + j], by, own[j]);
        }
    }
}

INLINE void add(value *to, const value *more, size_t count) {
    for (size_t i = 0; i < count; i++) to[i] = (value){.re = to[i].re + more[i].re, .im = to[i].im + more[i].im};
}

/* Add the effect of the attachments to G (p, k). X (p, b): accelerations at points per force at an attachment. */
INLINE void by_eras(value *restrict G, size_t p, const value *X, const touched *of, const plates *on) {
    for (size_t i = 0; i < p; i++) {
        row_product(of->row, X + i * on->b, 1, of->through, on->b, on->k, 0, 0);
        add(G + i * on->k, of->row, on->k);
    }
}

/* Compute G (p, k): displacement at points (p, r) per force at a finger, without the fingers' load. X (p, b):
 * accelerations there per force at an attachment; NULL leaves the attachments out. */
INLINE void by_fingers(value *restrict G, const float *points, size_t p, const value *X, const touched *of,
                       const plates *on) {
    const size_t k = on->k, r = on->r;
    value *modal = of->row + on->b + k;
    for (size_t j = 0; j < k; j++) {
        for (size_t s = 0; s < r; s++) modal[s] = scaled(of->g[s], filled(on->centers[j * r + s]));
        multiply_into(G + j, k, points, modal, p, r);
    }
    if (X) by_eras(G, p, X, of, on);
}

/* Return the row of a lane in a block; lanes beyond the last row repeat it. */
INLINE int row_of_block(const plates *on, int first, int l) { return first + l < on->rows ? first + l : on->rows - 1; }

/* Return T of cases that form a stored block (consecutive frequencies at one of the first thicknesses), otherwise
 * NULL. */
INLINE const value *of_block(const plates *on, const int *rows, const int *cases) {
    const int thickness = cases[0] - rows[0] * on->t;
    int is_block = on->lanes == LANES && rows[0] % LANES == 0 && thickness < on->kept;
    for (int l = 1; l < LANES; l++) {
        is_block &= rows[l] == row_of_block(on, rows[0], l);
        is_block &= cases[l] - rows[l] * on->t == thickness;
    }
    return is_block ? on->of_blocks + (size_t)(rows[0] / LANES * on->kept + thickness) * on->b * on->r : NULL;
}

/* Assign the arrays to places in the work space; return its end. */
INLINE value *place(touched *to, const plates *on, value *work) {
    const size_t b = on->b, k = on->k, r = on->r;
    to->g = work + b * r, to->Y = to->g + r, to->at = to->Y + b * b;
    to->resting = to->at + k * b, to->P = to->resting + k * b, to->D = to->P + k * k, to->G = to->D + k;
    to->through = to->G + k * k, to->held = to->through + b * k, to->forced = to->held + k * b;
    to->row = to->forced + k * k;
    return to->row + b + k + r;
}

/* Compute all arrays that follow from `at` and from G of the plate without attachments. */
SHARED void couple(touched *to, const plates *on, const int *rows, const int *cases) {
    const size_t b = on->b, k = on->k;
    load(to->Y, on->coupling, b * b, cases);
    load(to->D, on->stiffness, k, rows);
    load_real(&to->minus_omega2, on->minus_omega2, 1, rows);
    for (size_t i = 0; i < k; i++) {
        row_product(to->row, to->at + i * b, 1, to->Y, b, b, 0, 0); /* Y is symmetric */
        for (size_t j = 0; j < b; j++) to->through[j * k + i] = to->row[j];
    }
    by_eras(to->G, k, to->at, to, on);
    memcpy(to->P, to->G, k * k * sizeof(value));
    invert(to->P, to->D, k);
    product(to->resting, to->P, k, to->at, k, k, b);
    for (size_t i = 0; i < k; i++) {
        for (size_t j = 0; j < b; j++) to->held[i * b + j] = subtract_product(ZERO, to->D[i], to->resting[i * b + j]);
        for (size_t j = 0; j < k; j++) to->forced[i * k + j] = scaled(to->P[j * k + i], to->minus_omega2);
    }
}

/* Put the fingers on the plate for frequencies (LANES) and cases (LANES); return the end of the work space. */
SHARED value *put_fingers(touched *to, const plates *on, const int *rows, const int *cases, value *work) {
    value *end = place(to, on, work);
    to->T = of_block(on, rows, cases);
    if (!to->T) load(work, on->by_force, (size_t)on->b * on->r, cases), to->T = work;
    load(to->g, on->receptance, on->r, cases);
    multiply(to->at, on->centers, to->T, on->k, on->r, on->b);
    by_fingers(to->G, on->centers, on->k, NULL, to, on);
    couple(to, on, rows, cases);
    return end;
}

/* Compute found (p, width): accelerations at points (p, r) per force at each of the first `width` attachments and
 * fingers. each: number of points per finger; room: work space (p, b + k). */
SHARED void to_points(value *restrict found, size_t width, const float *points, size_t p, size_t each, const touched *of,
                      const plates *on, value *room) {
    const size_t b = on->b, k = on->k;
    const value *X = of->at, *G = of->G; /* at the fingers' centers */
    if (points != on->centers || p != k) {
        value *of_eras = room, *of_fingers = room + p * b;
        const size_t r = on->r;
        for (size_t first = 0, next; first < p; first = next) {
            size_t finger = 0;
            next = first + each;
            while (finger < k && memcmp(points + first * r, on->centers + finger * r, r * sizeof(float))) finger++;
            if (finger < k) { /* the first point is the finger's center, which is computed already */
                memcpy(of_eras + first * b, of->at + finger * b, b * sizeof(value));
                memcpy(of_fingers + first * k, of->G + finger * k, k * sizeof(value));
                first++;
            }
            multiply(of_eras + first * b, points + first * r, of->T, next - first, r, b);
            by_fingers(of_fingers + first * k, points + first * r, next - first, of_eras + first * b, of, on);
        }
        X = of_eras, G = of_fingers;
    }
    for (size_t i = 0; i < p; i++) {
        row_product(of->row, G + i * k, 1, of->held, k, b, 0, 0);
        add(of->row, X + i * b, b);
        if (width > b) row_product(of->row + b, G + i * k, 1, of->forced, k, k, 0, 0);
        memcpy(found + i * width, of->row, width * sizeof(value));
    }
}

/* Compute moved (b + k, n): displacement of attachments and fingers per ERA at full stroke. without (b, n): the same
 * without fingers. */
INLINE void with_fingers_moved(value *moved, const value *without, const touched *of, const value *drives,
                               const plates *on) {
    const size_t n = on->n, b = on->b, k = on->k;
    lanes by_motion = inverse(of->minus_omega2);
    value *fingers = moved + b * n;
    for (size_t i = 0; i < k; i++)
        for (size_t e = 0; e < n; e++)
            fingers[i * n + e] = scaled(times(of->resting[i * b + e], drives[e]), by_motion);
    memcpy(moved, without, b * n * sizeof(value));
    for (size_t i = 0; i < k; i++)
        for (size_t j = 0; j < b; j++) {
            value by = scaled(times(of->at[i * b + j], of->D[i]), by_motion);
            for (size_t e = 0; e < n; e++)
                moved[j * n + e] = subtract_product(moved[j * n + e], by, fingers[i * n + e]);
        }
}

#endif
