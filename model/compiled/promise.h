/* Levels and contrasts at all fingers while all contents play, on the nominal plate and on drawn plates. */
#ifndef PROMISE_H
#define PROMISE_H

#include "answer.h"

/* Powers of contents relative to the threshold (contents, groups, points), and their gains. */
typedef struct {
    const plates *on;
    const rules *by;
    const question *of;
    const int *rows;
    const lanes *powers;
    const lanes *harmonics; /* (contents, k, groups) mean over the fingertips */
    const float *gains, *harmonic_gains; /* per content: gain of the tone, and of its second harmonic */
    size_t groups, plates;
} felt;

static const float FAINT = 1e-20f;

INLINE lanes root_of(const felt *of, size_t content, size_t group, size_t point) {
    const size_t points = of->on->k * of->of->fine;
    return of->gains[content] * root(of->powers[(content * of->groups + group) * points + point]);
}

/* Return the mean amplitude of a content over a fingertip, reduced by contents of the same frequency, which can cancel
 * it. alone: ignore other contents. */
SHARED lanes own_amplitude(const felt *of, size_t content, size_t group, size_t finger, int alone) {
    const size_t fine = of->of->fine;
    lanes mean = {0};
    for (size_t i = finger * fine; i < (finger + 1) * fine; i++) {
        lanes own = root_of(of, content, group, i);
        for (size_t other = 0; !alone && other < (size_t)of->of->contents; other++)
            if (other != content && of->rows[other] == of->rows[content]) own -= root_of(of, other, group, i);
        mean += of->of->fine_weights[i] * larger(own, ZERO.re);
    }
    return mean;
}

/* Return the power of all contents except one at the loudest point of a finger; amplitudes of equal frequency add. */
SHARED lanes foreign_power(const felt *of, size_t without, size_t group, size_t finger) {
    const size_t fine = of->of->fine, contents = of->of->contents, points = of->on->k * fine;
    lanes loudest = {0};
    for (size_t i = finger * fine; i < (finger + 1) * fine; i++) {
        lanes total = {0};
        for (size_t content = 0; content < contents; content++) {
            int is_first = content != without, is_single = 1;
            for (size_t other = 0; other < contents; other++) {
                if (other == content || other == without || of->rows[other] != of->rows[content]) continue;
                is_single = 0, is_first &= other > content;
            }
            if (!is_first) continue;
            lanes power = of->gains[content] * of->gains[content] * of->powers[(content * of->groups + group) * points + i];
            if (!is_single) {
                lanes sum = {0};
                for (size_t other = content; other < contents; other++)
                    if (other != without && of->rows[other] == of->rows[content]) sum += root_of(of, other, group, i);
                power = sum * sum;
            }
            total += power;
        }
        loudest = larger(loudest, total);
    }
    for (size_t content = 0; content < contents; content++)
        if (content != without)
            loudest += of->harmonic_gains[content] * of->harmonic_gains[content] *
                       of->harmonics[(content * of->on->k + finger) * of->groups + group];
    return loudest;
}

INLINE lanes weakest_target(const felt *of, size_t content, size_t group, int alone) {
    lanes found = filled(INFINITY);
    for (int t = of->of->starts[content]; t < of->of->starts[content + 1]; t++)
        found = smaller(found, own_amplitude(of, content, group, of->of->targets[t], alone));
    return found;
}

INLINE void keep(float *values, lanes found, const draws *by, size_t group) {
    size_t first, count = plates_of(by, group, &first);
    memcpy(values + first, &found, count * sizeof(float));
}

/* Lower the gains of some contents until they fit into the free stroke, by max-min fairness: the level of all rises until
 * it is a content's own, or until an ERA is full, which ends the rise of every content that uses it. strokes (contents,
 * n): of each content at its full level; return the smallest factor. */
SHARED float lower_to_stroke(float *gains, const float *strokes, const float *levels, const int *is_sharing,
                             const float *free_stroke, size_t contents, size_t n, arena *memory) {
    const arena mark = *memory;
    float *factors = floats(memory, contents), *level_by_era = floats(memory, n), least = 1;
    int *is_rising = integers(memory, contents);
    for (size_t j = 0; j < contents; j++) factors[j] = 1, is_rising[j] = is_sharing[j];
    for (size_t round = 0; round < contents; round++) { /* at least one content ends in each */
        float level = INFINITY;
        for (size_t e = 0; e < n; e++) {
            float settled = 0, per_level = 0;
            for (size_t j = 0; j < contents; j++) {
                if (is_rising[j]) per_level += strokes[j * n + e] / levels[j];
                else if (is_sharing[j]) settled += factors[j] * strokes[j * n + e];
            }
            level_by_era[e] = per_level > LEAST ? fmaxf(free_stroke[e] - settled, 0) / per_level : INFINITY;
            level = fminf(level, level_by_era[e]);
        }
        int any_reached = 0;
        for (size_t j = 0; j < contents; j++)
            if (is_rising[j] && levels[j] <= level) is_rising[j] = 0, any_reached = 1;
        for (size_t j = 0; j < contents && !any_reached; j++) {
            int is_limited = 0;
            for (size_t e = 0; e < n; e++)
                if (level_by_era[e] <= level * (1 + NEARLY) && strokes[j * n + e] > 0) is_limited = is_rising[j];
            if (is_limited) factors[j] = level / levels[j], is_rising[j] = 0;
        }
    }
    for (size_t j = 0; j < contents; j++)
        if (is_sharing[j]) gains[j] *= factors[j], least = fminf(least, factors[j]);
    release(memory, mark);
    return least;
}

/* Lower the gains until all contents fit into the stroke; return the smallest factor. Higher priorities get the stroke
 * first; contents of one priority share what remains (`lower_to_stroke`). */
SHARED float share_stroke(float *gains, const question *of, const float *weights, size_t n, arena *memory) {
    const size_t contents = of->contents;
    const arena mark = *memory;
    float *strokes = floats(memory, contents * n), *free_stroke = floats(memory, n), least = 1;
    int *is_done = integers(memory, contents), *is_sharing = integers(memory, contents);
    for (size_t i = 0; i < contents * n; i++) strokes[i] = gains[i / n] * hypotf(weights[2 * i], weights[2 * i + 1]);
    for (size_t e = 0; e < n; e++) free_stroke[e] = 1;
    memset(is_done, 0, contents * sizeof(int));
    for (;;) {
        int highest = 0, any = 0;
        for (size_t j = 0; j < contents; j++)
            if (!is_done[j] && (!any || of->priority[j] > highest)) highest = of->priority[j], any = 1;
        if (!any) break;
        for (size_t j = 0; j < contents; j++) is_sharing[j] = !is_done[j] && of->priority[j] == highest;
        const float factor =
            lower_to_stroke(gains, strokes, of->level, is_sharing, free_stroke, contents, n, memory);
        least = fminf(least, factor);
        for (size_t e = 0; e < n; e++) {
            float used = 0;
            for (size_t j = 0; j < contents; j++)
                if (is_sharing[j]) used += gains[j] * hypotf(weights[2 * (j * n + e)], weights[2 * (j * n + e) + 1]);
            /* rounding must not leave a rest of the stroke */
            free_stroke[e] = used >= free_stroke[e] * (1 - NEARLY) ? 0 : free_stroke[e] - used;
        }
        for (size_t j = 0; j < contents; j++) is_done[j] |= is_sharing[j];
    }
    release(memory, mark);
    return least;
}

INLINE float promised(float *values, const felt *of, float percent) {
    return percentile(values + 1, of->plates - 1, percent);
}

INLINE void to_decibels(float *ratios, size_t count) {
    for (size_t i = 0; i < count; i++) ratios[i] = 20 * log10f(ratios[i]);
}

/* Lower figures (3) to the nominal, the median and the promised value of ratios, if these are lower. */
INLINE void lower(float *figures, float *ratios, const felt *of) {
    const float found[3] = {ratios[0], promised(ratios, of, 50), promised(ratios, of, of->by->promised)};
    for (int i = 0; i < 3; i++) figures[i] = fminf(figures[i], found[i]);
}

/* Compute foreign levels for a threshold set, and lower contrasts to the contrasts for this set; for the first set,
 * also compute levels. The gains in `now` are relative to the set. */
SHARED void compare(answered *to, const felt *now, int set, float *own, float *some, float *worst, arena *memory) {
    const question *of = now->of;
    const size_t contents = of->contents, plates = now->plates, groups = now->groups;
    const arena mark = *memory;
    float *power = floats(memory, plates);
    for (size_t i = 0; i < plates; i++) worst[i] = INFINITY;
    int any = 0;
    for (size_t j = 0; j < contents; j++)
        for (size_t group = 0; group < groups; group++)
            keep(own + j * plates, weakest_target(now, j, group, 0), of->promise, group);
    for (size_t each = 0; each < (size_t)of->starts[contents] + of->quiet_count; each++) {
        const int is_quiet = each >= (size_t)of->starts[contents];
        const size_t finger = is_quiet ? of->quiet[each - of->starts[contents]] : of->targets[each];
        size_t j = 0;
        while (!is_quiet && each >= (size_t)of->starts[j + 1]) j++;
        if (is_quiet) {
            memcpy(some, own, plates * sizeof(float));
            for (size_t other = 1; other < contents; other++)
                for (size_t i = 0; i < plates; i++) some[i] = fminf(some[i], own[other * plates + i]);
        } else {
            for (size_t group = 0; group < groups; group++)
                keep(some, own_amplitude(now, j, group, finger, 0), of->promise, group);
            if (!set) {
                memcpy(power, some, plates * sizeof(float));
                to->level[2 * finger] = power[0], to->level[2 * finger + 1] = promised(power, now, now->by->promised);
            }
            if (contents == 1) continue;
        }
        for (size_t group = 0; group < groups; group++)
            keep(power, foreign_power(now, is_quiet ? contents : j, group, finger), of->promise, group);
        for (size_t i = 0; i < plates; i++) {
            some[i] /= sqrtf(fmaxf(power[i], FAINT));
            worst[i] = fminf(worst[i], some[i]);
        }
        any = 1;
        to->foreign[finger * now->by->sets + set] = sqrtf(promised(power, now, 100 - now->by->promised));
        lower(to->contrast + 3 * finger, some, now);
    }
    if (any) {
        for (int t = 0; contents == 1 && t < of->starts[1]; t++) { /* a single content has the contrast of the
                                                                    * loudest quiet finger */
            memcpy(some, worst, plates * sizeof(float));
            lower(to->contrast + 3 * of->targets[t], some, now);
        }
        to->of_all[0] = fminf(to->of_all[0], promised(worst, now, now->by->promised));
    }
    release(memory, mark);
}

/* Compute gains, levels and contrasts of the tones in `to`. */
SHARED void promise(answered *to, const plates *on, const rules *by, const question *of, const float *columns,
                    arena *memory) {
    const size_t contents = of->contents, k = on->k, points = k * of->fine, groups = group_count(of->promise);
    const arena mark = *memory;
    const size_t plates = 1 + of->promise->count;
    const sensors at = {.points = points, .rows = of->fine_points, .weights = of->fine_weights, .error = by->error,
                        .threshold = by->threshold, .touch_steps = of->touch_steps, .disc = of->disc};
    const tones drawn = respond(on, of->promise, &at, columns, contents, to->rows, to->weights, memory);
    lanes *powers = take(memory, contents * groups * points * sizeof(lanes));
    value *found = values(memory, points), *force = values(memory, on->b + k + 1);
    for (size_t content = 0; content < contents; content++)
        for (size_t group = 0; group < groups; group++)
            sense(powers + (content * groups + group) * points, &drawn, content, group, found, force);
    felt now = {.on = on, .by = by, .of = of, .rows = to->rows, .powers = powers, .gains = to->gains, .groups = groups,
                .plates = plates};
    now.harmonics = find_harmonics(&of->harmonics, of->promise, k, contents, to->rows, to->weights, memory);

    float *own = floats(memory, contents * plates), *some = floats(memory, plates), *worst = floats(memory, plates);
    for (size_t j = 0; j < contents; j++) {
        to->gains[j] = 1;
        for (size_t group = 0; group < groups; group++) keep(own, weakest_target(&now, j, group, 1), of->promise, group);
        to->gains[j] = of->level[j] / fmaxf(promised(own, &now, by->promised), LEAST);
    }
    to->of_all[1] = share_stroke(to->gains, of, to->weights, on->n, memory);

    for (size_t i = 0; i < 3 * k; i++) to->contrast[i] = NAN;
    for (size_t i = 0; i < 2 * k; i++) to->level[i] = NAN;
    for (size_t i = 0; i < k * by->sets; i++) to->foreign[i] = NAN;
    to->of_all[0] = NAN;
    float *gains = floats(memory, contents), *harmonic_gains = floats(memory, contents);
    now.gains = gains, now.harmonic_gains = harmonic_gains;
    for (int set = 0; set < by->sets; set++) {
        for (size_t j = 0; j < contents; j++) {
            const size_t at = to->rows[j] * by->sets + set;
            gains[j] = to->gains[j] * by->sensitivities[at];
            harmonic_gains[j] = to->gains[j] * by->harmonic_sensitivities[at];
        }
        compare(to, &now, set, own, some, worst, memory);
    }
    to_decibels(to->contrast, 3 * k), to_decibels(to->level, 2 * k), to_decibels(to->foreign, k * by->sets);
    to_decibels(to->of_all, 1);
    release(memory, mark);
}

#endif
