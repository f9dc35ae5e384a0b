/* Second harmonics of tones on drawn plates. Reference: `TouchedPlate.harmonics`. */
#ifndef HARMONICS_H
#define HARMONICS_H

#include "drawn.h"

/* The plate at twice the frequencies (NULL if ERAs have no harmonics), and the coarse points of each finger (k, few,
 * r) with their weights (k, few). Its first thicknesses are those of the plate at the table's frequencies. */
typedef struct {
    const plates *on;
    const float *threshold; /* (f) at twice the frequencies */
    const float *points, *weights;
    size_t few;
} distortion;

/* Return fields (m, bases, b + k, 2, padded) per ERA at the tones' weights (m, n), for harmonics as large as the tone. */
SHARED float *harmonic_fields(const distortion *at, const draws *by, size_t m, const int *rows, const float *weights,
                              size_t padded, arena *memory) {
    const plates *on = at->on;
    const size_t n = on->n, bases = by->bases, cases_in_all = m * bases, points = on->k * at->few;
    const size_t each = 2 * (on->b + on->k) * padded;
    float *fields = floats(memory, cases_in_all * each);
    const arena mark = *memory;
    const float *columns = columns_of(at->points, points, on, memory);
    value *space = values(memory, touched_space(on));
    for (size_t first = 0; first < cases_in_all; first += LANES) {
        const size_t count = cases_in_all - first < LANES ? cases_in_all - first : LANES;
        int of_table[LANES], cases[LANES];
        for (size_t l = 0; l < LANES; l++) {
            const size_t case_number = first + (l < count ? l : count - 1);
            of_table[l] = rows[case_number / bases];
            cases[l] = of_table[l] * on->t + by->first_base + (int)(case_number % bases);
        }
        touched of;
        float *found = fields + each * first;
        put_fingers_at_points(&of, found, each, on, of_table, cases, count, columns, padded, points, space, memory);
        for (size_t l = 0; l < count; l++)
            for (size_t e = 0; e < n; e++) {
                const float *drive = on->drives + 2 * (of_table[l] * n + e), *w = weights + 2 * ((first + l) / bases * n + e);
                const float re = drive[0] * w[0] - drive[1] * w[1], im = drive[0] * w[1] + drive[1] * w[0];
                for (size_t point = 0; point < padded; point += LANES) {
                    float *own = found + each * l + 2 * padded * e + point;
                    const value by_force = {.re = some(own), .im = some(own + padded)};
                    const value driven = add_scaled(ZERO, by_force, re, im);
                    memcpy(own, &driven.re, sizeof(lanes)), memcpy(own + padded, &driven.im, sizeof(lanes));
                }
            }
    }
    release(memory, mark);
    return fields;
}

/* Return (m, k, groups): mean squared amplitudes over the fingertips relative to the threshold; 0 on the nominal
 * plate. */
SHARED lanes *find_harmonics(const distortion *at, const draws *by, size_t k, size_t m, const int *rows,
                             const float *weights, arena *memory) {
    const size_t groups = group_count(by);
    lanes *found = take(memory, m * k * groups * sizeof(lanes));
    memset(found, 0, m * k * groups * sizeof(lanes));
    if (!at->on) return found;
    const arena mark = *memory;
    const size_t n = at->on->n, few = at->few, width = by->width;
    const size_t padded = padded_to(k * few + k), each = 2 * (at->on->b + k) * padded;
    const float *fields = harmonic_fields(at, by, m, rows, weights, padded, memory);
    value *drawn = values(memory, n);
    for (size_t group = 1; group < groups; group++) {
        size_t first;
        plates_of(by, group, &first);
        for (size_t e = 0; e < n; e++)
            drawn[e] = (value){.re = some(by->harmonics + e * width + first - 1),
                               .im = some(by->harmonics + (n + e) * width + first - 1)};
        for (size_t tone = 0; tone < m; tone++) {
            const size_t base = tone * by->bases + (group - 1) / groups_of(by);
            const float threshold = at->threshold[rows[tone]], above = 1 / (threshold * threshold);
            for (size_t finger = 0; finger < k; finger++) {
                lanes mean = {0};
                for (size_t i = finger * few; i < (finger + 1) * few; i++) {
                    const float *field = fields + each * base + i;
                    value sum = ZERO;
                    for (size_t e = 0; e < n; e++)
                        sum = add_scaled(sum, drawn[e], field[2 * padded * e], field[2 * padded * e + padded]);
                    mean += at->weights[i] * power(sum);
                }
                found[(tone * k + finger) * groups + group] = above * mean;
            }
        }
    }
    release(memory, mark);
    return found;
}

#endif
