/* Second harmonics of tones on drawn plates: `TouchedPlate.harmonics` in C. */
#ifndef HARMONICS_H
#define HARMONICS_H

#include "drawn.h"

/* Plates at twice the frequencies, whose first thicknesses are those of the others; at few points of each finger
 * (k, few, r) of weights (k, few). No plates where ERAs have no harmonics. */
typedef struct {
    const plates *on;
    const float *threshold; /* (f) at twice the frequencies */
    const float *points, *weights;
    size_t few;
} distortion;

/* fields (m, bases, points, n): by each ERA at tones' weights (m, n), at full harmonics. */
SHARED float *harmonic_fields(const distortion *at, const draws *by, size_t m, const int *rows, const float *weights,
                              arena *memory) {
    const plates *on = at->on;
    const size_t n = on->n, bases = by->bases, cases_in_all = m * bases, points = on->k * at->few, each = points * n;
    float *fields = floats(memory, 2 * cases_in_all * each);
    const arena mark = *memory;
    value *space = values(memory, touched_space(on)), *room = values(memory, points * (on->b + on->k));
    value *found = values(memory, each), *w = values(memory, n), *drives = values(memory, n);
    for (size_t first = 0; first < cases_in_all; first += LANES) {
        const size_t count = cases_in_all - first < LANES ? cases_in_all - first : LANES;
        int of_table[LANES], cases[LANES], given[LANES];
        for (size_t l = 0; l < LANES; l++) {
            const size_t case_number = first + (l < count ? l : count - 1);
            given[l] = case_number / bases, of_table[l] = rows[given[l]];
            cases[l] = of_table[l] * on->t + by->first_base + (int)(case_number % bases);
        }
        touched of;
        put_fingers(&of, on, of_table, cases, space);
        to_points(found, n, at->points, points, at->few, &of, on, room);
        load(drives, on->drives, n, of_table);
        load(w, weights, n, given);
        for (size_t e = 0; e < n; e++) drives[e] = times(drives[e], w[e]);
        for (size_t i = 0; i < each; i++) found[i] = times(found[i], drives[i % n]);
        store(fields + 2 * first * each, found, each, count);
    }
    release(memory, mark);
    return fields;
}

/* found (m, k, groups): squared amplitudes to threshold, mean over each fingertip; none of the nominal plate. */
SHARED lanes *find_harmonics(const distortion *at, const draws *by, size_t k, size_t m, const int *rows,
                             const float *weights, arena *memory) {
    const size_t groups = group_count(by);
    lanes *found = take(memory, m * k * groups * sizeof(lanes));
    memset(found, 0, m * k * groups * sizeof(lanes));
    if (!at->on) return found;
    const arena mark = *memory;
    const size_t n = at->on->n, few = at->few, width = by->width;
    const float *fields = harmonic_fields(at, by, m, rows, weights, memory);
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
                    const float *field = fields + 2 * (base * k * few + i) * n;
                    value sum = ZERO;
                    for (size_t e = 0; e < n; e++) sum = add_scaled(sum, drawn[e], field[2 * e], field[2 * e + 1]);
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
