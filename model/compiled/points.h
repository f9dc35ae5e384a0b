/* Accelerations at many points for few cases: lanes are points, and cases follow one another. */
#ifndef POINTS_H
#define POINTS_H

#include "arena.h"
#include "fingers.h"

INLINE lanes some(const float *from) {
    lanes found;
    memcpy(&found, from, sizeof found);
    return found;
}

/* sum + (re + i im) f. */
INLINE value add_scaled(value sum, value f, float re, float im) {
    return (value){.re = sum.re + re * f.re - im * f.im, .im = sum.im + re * f.im + im * f.re};
}

/* Compute found (count, 2, padded): real and imaginary parts at points, for reduced coordinates (count, r) and shapes
 * `columns` (r, padded). each: distance between results of different coordinates. */
SHARED void at_points(float *found, size_t each, const float *coordinates, size_t count, const float *columns, size_t padded,
                      size_t r) {
    for (size_t first = 0; first < count; first += 4)
        for (size_t point = 0; point < padded; point += LANES) {
            const float *of[4];
            value s[4] = {ZERO, ZERO, ZERO, ZERO};
            for (size_t i = 0; i < 4; i++) of[i] = coordinates + 2 * r * (first + i < count ? first + i : first);
            for (size_t j = 0; j < r; j++) {
                lanes shape;
                memcpy(&shape, columns + j * padded + point, sizeof shape);
                s[0].re += shape * of[0][2 * j], s[0].im += shape * of[0][2 * j + 1];
                s[1].re += shape * of[1][2 * j], s[1].im += shape * of[1][2 * j + 1];
                s[2].re += shape * of[2][2 * j], s[2].im += shape * of[2][2 * j + 1];
                s[3].re += shape * of[3][2 * j], s[3].im += shape * of[3][2 * j + 1];
            }
            for (size_t i = 0; i < 4 && first + i < count; i++) {
                float *to = found + each * (first + i) + point;
                memcpy(to, &s[i].re, sizeof(lanes));
                memcpy(to + padded, &s[i].im, sizeof(lanes));
            }
        }
}

INLINE size_t padded_to(size_t points) { return (points + LANES - 1) / LANES * LANES; }

/* Return the shapes at points (points, r) and then at the fingers' centers as columns (r, padded). */
SHARED float *columns_of(const float *rows, size_t points, const plates *on, arena *memory) {
    const size_t r = on->r, every = points + on->k, padded = padded_to(every);
    float *found = floats(memory, r * padded);
    for (size_t j = 0; j < r; j++)
        for (size_t i = 0; i < padded; i++)
            found[j * padded + i] = i < points ? rows[i * r + j] : i < every ? on->centers[(i - points) * r + j] : 0;
    return found;
}

/* Add the effect of the fingers, in place, to accelerations at points per force at an attachment and displacements per
 * force at a finger (b + k, 2, padded). through: arrays `through` (b, k), `held` (k, b) and `forced` (k, k) of
 * `touched`. */
SHARED void add_fingers(float *at, const float *through, const plates *on, size_t padded) {
    const size_t b = on->b, k = on->k;
    const float *held = through + 2 * b * k, *forced = held + 2 * k * b;
    value G[k];
    for (size_t point = 0; point < padded; point += LANES) {
        float *re = at + point, *im = re + padded;
        for (size_t i = 0; i < k; i++) {
            const size_t own = 2 * padded * (b + i);
            G[i] = (value){.re = some(re + own), .im = some(im + own)};
            for (size_t j = 0; j < b; j++) {
                const value X = {.re = some(re + 2 * padded * j), .im = some(im + 2 * padded * j)};
                G[i] = add_scaled(G[i], X, through[2 * (j * k + i)], through[2 * (j * k + i) + 1]);
            }
        }
        for (size_t j = 0; j < b + k; j++) {
            value found = ZERO;
            if (j < b) found = (value){.re = some(re + 2 * padded * j), .im = some(im + 2 * padded * j)};
            for (size_t i = 0; i < k; i++) {
                const float *by = j < b ? held + 2 * (i * b + j) : forced + 2 * (i * k + j - b);
                found = add_scaled(found, G[i], by[0], by[1]);
            }
            memcpy(re + 2 * padded * j, &found.re, sizeof(lanes)), memcpy(im + 2 * padded * j, &found.im, sizeof(lanes));
        }
    }
}

/* Put the fingers on the plate for cases (count, up to LANES) as in `put_fingers`, but without T and g. Also compute
 * found (b + k, 2, padded) for each case: accelerations at points per force at an attachment or finger. each: distance
 * between cases; columns: from `columns_of`. */
SHARED void put_fingers_at_points(touched *to, float *found, size_t each, const plates *on, const int *rows, const int *cases,
                                  size_t count, const float *columns, size_t padded, size_t points, value *space,
                                  arena *memory) {
    const size_t b = on->b, k = on->k, r = on->r, coupled = 2 * b * k + k * k;
    const arena mark = *memory;
    float *modal = floats(memory, 2 * LANES * r), *by = floats(memory, 2 * LANES * coupled);
    place(to, on, space);
    for (size_t i = 0; i < k; i++) {
        for (size_t l = 0; l < count; l++)
            for (size_t s = 0; s < 2 * r; s++)
                modal[2 * r * l + s] = on->receptance[2 * r * cases[l] + s] * on->centers[i * r + s / 2];
        at_points(found + 2 * padded * (b + i), each, modal, count, columns, padded, r);
    }
    for (size_t l = 0; l < LANES; l++) {
        float *own = found + each * (l < count ? l : count - 1);
        if (l < count) at_points(own, 2 * padded, on->by_force + 2 * b * r * cases[l], b, columns, padded, r);
        for (size_t i = 0; i < k; i++)
            for (size_t j = 0; j < b + k; j++) {
                value *at = j < b ? to->at + i * b + j : to->G + i * k + j - b;
                at->re[l] = own[2 * padded * j + points + i], at->im[l] = own[2 * padded * j + padded + points + i];
            }
    }
    couple(to, on, rows, cases);
    store(by, to->through, coupled, count);
    for (size_t l = 0; l < count; l++) add_fingers(found + each * l, by + 2 * coupled * l, on, padded);
    release(memory, mark);
}

#endif
