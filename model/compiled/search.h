/* Search for the weights of all ERAs at one frequency for the targets of one content. Reference: `model.phased_weights`. */
#ifndef SEARCH_H
#define SEARCH_H

#include "arena.h"

typedef struct {
    int steps, limited;   /* number of weights tried; whether weights are limited to full stroke at the level */
    float variance, gain; /* extra gain variance per ERA; gain up to full stroke, 0 for none */
    float reserve, growth, most;
} method;

/* How the phases at several targets are aligned. */
typedef struct {
    int starts, iterations, again; /* number of starts; iterations from each start; iterations from the previous
                                    * step's result */
} phases;

/* The problem at LANES frequencies. points: number of points per quiet finger that count individually; 0 if the mean
 * counts. */
typedef struct {
    size_t n, targets, quiet, points, few, fine;
    phases phases;
    float margin;
    lanes wanted;
    const value *target, *target_power; /* (targets, n), (targets, n, n) */
    const value *const *forms;          /* (quiet) forms (n, n); only upper triangles are used */
    const value *at_points;             /* (quiet points, n) fields, in addition to the forms */
    const value *few_fields, *fine_fields; /* (quiet few, n), (quiet fine, n) */
} searched;

/* The best weights (n) that reach the level, their score, the best score of weights that miss the level, and an upper
 * bound. */
typedef struct {
    value *weights;
    lanes score, missed, bound;
} best;

static const float LEAST = 1e-30f, TINY = 1e-7f, LEAST_FIELD = 1e-20f, STABLE = 1 + 1e-5f;

INLINE size_t constraints(const searched *on) { return on->quiet * (on->points ? on->points : 1); }

/* w^H R w with Hermitian R. */
INLINE lanes expected(const value *R, const value *w, size_t n) {
    lanes sum = {0};
    for (size_t i = 0; i < n; i++) {
        value moved = scaled(w[i], R[i * n + i].re * 0.5f);
        for (size_t j = i + 1; j < n; j++) moved = add_product(moved, R[i * n + j], w[j]);
        sum += w[i].re * moved.re + w[i].im * moved.im;
    }
    return 2 * sum;
}

/* Sum of a times w. */
INLINE value field(const value *a, const value *w, size_t n) {
    value sum = ZERO;
    for (size_t i = 0; i < n; i++) sum = add_product(sum, a[i], w[i]);
    return sum;
}

/* Compute the expected power at each quiet fingertip or at each of its points. */
SHARED void quiet_power(lanes *restrict found, const searched *on, const value *w) {
    size_t n = on->n;
    for (size_t q = 0; q < on->quiet; q++) {
        lanes own = expected(on->forms[q], w, n);
        for (size_t i = q * on->points; i < (q + 1) * on->points; i++)
            found[i] = own + power(field(on->at_points + i * n, w, n));
        if (on->points) continue;
        found[q] = own;
        if (!on->few) continue;
        lanes mean = {0}, loudest = {0};
        for (size_t i = q * on->few; i < (q + 1) * on->few; i++)
            mean += power(field(on->few_fields + i * n, w, n));
        for (size_t i = q * on->fine; i < (q + 1) * on->fine; i++)
            loudest = larger(loudest, power(field(on->fine_fields + i * n, w, n)));
        found[q] += larger(loudest - mean, ZERO.re);
    }
}

/* Return the amplitude at the weakest target; least: the same after subtracting the margin. */
SHARED lanes amplitude(lanes *least, const searched *on, const value *w) {
    const size_t n = on->n;
    lanes found = filled(INFINITY);
    *least = found;
    for (size_t t = 0; t < on->targets; t++) {
        lanes size = power(field(on->target + t * n, w, n)), own = root(size), left = own;
        if (on->margin != 0) left -= on->margin * root(expected(on->target_power + t * n * n, w, n) - size);
        found = smaller(found, own), *least = smaller(*least, left);
    }
    return found;
}

INLINE lanes loudest_of(const lanes *power, size_t count) {
    lanes found = power[0];
    for (size_t i = 1; i < count; i++) found = larger(found, power[i]);
    return found;
}

/* Compute R (n, n), upper triangle: the forms of the quiet fingertips, weighted by shares. */
INLINE void weighted(value *restrict R, const searched *on, const lanes *share) {
    const size_t n = on->n, points = on->points;
    memset(R, 0, n * n * sizeof(value));
    for (size_t q = 0; q < on->quiet; q++) {
        lanes own = points ? ZERO.re : share[q];
        for (size_t i = q * points; i < (q + 1) * points; i++) own += share[i];
        for (size_t u = 0; u < n; u++)
            for (size_t v = u; v < n; v++) {
                const value form = on->forms[q][u * n + v];
                R[u * n + v].re += own * form.re, R[u * n + v].im += own * form.im;
            }
        for (size_t i = q * points; i < (q + 1) * points; i++)
            for (size_t u = 0; u < n; u++) {
                value by = scaled(on->at_points[i * n + u], share[i]);
                for (size_t v = u; v < n; v++)
                    R[u * n + v] = add_conjugate_product(R[u * n + v], by, on->at_points[i * n + v]);
            }
    }
}

/* w (n) = sum of columns (targets, n) times factors, scaled to a largest magnitude of 1. */
SHARED void weigh(value *restrict w, const value *columns, const value *factor, size_t targets, size_t n) {
    lanes most = {0};
    for (size_t u = 0; u < n; u++) {
        w[u] = ZERO;
        for (size_t t = 0; t < targets; t++) w[u] = add_product(w[u], columns[t * n + u], factor[t]);
        most = larger(most, power(w[u]));
    }
    most = inverse(larger(root(most), filled(LEAST)));
    for (size_t u = 0; u < n; u++) w[u] = scaled(w[u], most);
}

/* Multiply by a gain, limited to full stroke. */
INLINE value saturated(value w, float gain) { return scaled(w, inverse(larger(root(power(w)), filled(1 / gain)))); }

/* Improve factors (targets) step by step: give each the phase of the field at its target, and raise those of weaker
 * targets. Keeps the best factors by the amplitude at the weakest target per root of the power, or, with a gain above
 * 1, by the amplitude of weights w (n) at this gain. */
SHARED void align(value *restrict best, lanes *highest, value *restrict factor, value *restrict w, float gain, int steps,
                  const value *gram, const value *columns, const searched *on) {
    const size_t targets = on->targets, n = on->n;
    const int is_raised = gain > 1;
    value reached[targets];
    lanes size[targets];
    for (int step = 0; step < steps; step++) {
        lanes weakest = filled(INFINITY), cost = {0}, most = {0};
        if (is_raised) weigh(w, columns, factor, targets, n);
        for (size_t u = 0; is_raised && u < n; u++) w[u] = saturated(w[u], gain);
        for (size_t t = 0; t < targets; t++) {
            reached[t] = is_raised ? field(on->target + t * n, w, n) : field(gram + t * targets, factor, targets);
            size[t] = larger(root(power(reached[t])), filled(LEAST_FIELD));
            weakest = smaller(weakest, size[t]);
            cost += factor[t].re * reached[t].re + factor[t].im * reached[t].im;
        }
        const lanes found = is_raised ? weakest : weakest / root(larger(cost, filled(LEAST)));
        const mask better = found > STABLE * *highest;
        *highest = chosen(better, found, *highest);
        for (size_t t = 0; t < targets; t++) {
            best[t].re = chosen(better, factor[t].re, best[t].re);
            best[t].im = chosen(better, factor[t].im, best[t].im);
            reached[t] = scaled(reached[t], inverse(size[t]));
            size[t] = root(power(factor[t])) / size[t];
            most = larger(most, size[t]);
        }
        for (size_t t = 0; t < targets; t++) factor[t] = scaled(reached[t], size[t] / most);
    }
}

/* Compute the weights w = R^-1 sum of conj(target) times factor of least power, with a largest magnitude of 1; return
 * their bound. Overwrites R. best (targets): the factors, on input those of the previous step unless this is the
 * first; gain: see `align`. */
SHARED lanes least_power(value *restrict w, value *restrict R, value *restrict best, int is_first, float gain,
                         const searched *on, arena *memory) {
    const size_t n = on->n, targets = on->targets, most_starts = on->phases.starts;
    const size_t starts = !is_first ? 1 : targets < most_starts ? targets : most_starts;
    const arena mark = *memory;
    value *columns = values(memory, targets * n), *gram = values(memory, targets * targets);
    value *factor = values(memory, targets);
    lanes highest = {0};
    factorize_hermitian(R, n);
    for (size_t t = 0; t < targets; t++) {
        value *column = columns + t * n;
        for (size_t u = 0; u < n; u++) column[u].re = on->target[t * n + u].re, column[u].im = -on->target[t * n + u].im;
        solve_hermitian(column, R, n);
        for (size_t u = 0; u <= t; u++) {
            const value found = field(on->target + u * n, column, n);
            gram[u * targets + t] = found;
            gram[t * targets + u] = (value){.re = found.re, .im = u < t ? -found.im : ZERO.im};
        }
    }
    if (targets == 1) best[0] = (value){.re = filled(1), .im = ZERO.im}, highest = root(gram[0].re);
    for (size_t start = 0; start < starts && targets > 1; start++) {
        for (size_t t = 0; t < targets; t++) {
            const value own = is_first ? gram[t * targets + start * targets / starts] : best[t];
            factor[t] = is_first ? scaled(own, inverse(larger(root(power(own)), filled(LEAST_FIELD)))) : own;
            if (!start) best[t] = factor[t];
        }
        align(best, &highest, factor, w, gain, is_first ? on->phases.iterations : on->phases.again, gram, columns, on);
    }
    weigh(w, columns, best, targets, n);
    release(memory, mark);
    return highest;
}

/* Search for the best weights in the steps of a method. */
SHARED void search(best *to, const searched *on, const method *by, arena *memory) {
    const size_t n = on->n, q = constraints(on);
    const arena mark = *memory;
    value *w = values(memory, n), *fitting = values(memory, n), *R = values(memory, n * n);
    value *factors = values(memory, on->targets);
    lanes *share = take(memory, q * sizeof(lanes)), *found = take(memory, q * sizeof(lanes));
    lanes *multiplier = take(memory, n * sizeof(lanes)), limit = {0};
    for (size_t i = 0; i < q; i++) share[i] = filled(1 / (float)q);
    for (size_t i = 0; i < n; i++) multiplier[i] = to->weights[i].re = to->weights[i].im = ZERO.re;
    to->score = to->missed = ZERO.re, to->bound = filled(INFINITY);

    for (int step = 0; step < by->steps; step++) {
        weighted(R, on, share);
        for (size_t u = 0; u < n; u++)
            R[u * n + u] = (value){.re = R[u * n + u].re * (1 + by->variance) + multiplier[u], .im = ZERO.im};
        to->bound = smaller(to->bound, least_power(w, R, factors, step == 0, by->gain, on, memory));
        lanes least;
        if (by->limited) {
            lanes amp = amplitude(&least, on, w);
            lanes gain = by->reserve * on->wanted / larger(least, 0.1f * amp + LEAST_FIELD);
            for (size_t u = 0; u < n; u++) w[u] = scaled(w[u], gain);
        }
        for (size_t u = 0; u < n; u++) fitting[u] = by->gain ? saturated(w[u], by->gain) : w[u];

        quiet_power(found, on, fitting);
        lanes amp = amplitude(&least, on, fitting);
        lanes power_of_quiet = larger(loudest_of(found, q), filled(LEAST)) + TINY * (amp * amp);
        lanes robust = amp / root(power_of_quiet);
        mask reaches = least >= on->wanted;
        to->missed = larger(to->missed, chosen(reaches, ZERO.re, robust));
        mask better = reaches & (robust > STABLE * to->score);
        to->score = chosen(better, robust, to->score);
        for (size_t u = 0; u < n; u++) {
            to->weights[u].re = chosen(better, fitting[u].re, to->weights[u].re);
            to->weights[u].im = chosen(better, fitting[u].im, to->weights[u].im);
        }
        if (step + 1 == by->steps) break;

        lanes total = {0};
        if (by->limited) {
            for (size_t u = 0; u < n; u++) total += power(w[u]);
            if (step == 0) {
                lanes own[q];
                quiet_power(own, on, w);
                lanes start = loudest_of(own, q) / larger(total, filled(LEAST));
                for (size_t u = 0; u < n; u++) multiplier[u] = start;
                limit = start * by->most;
            }
            for (size_t u = 0; u < n; u++)
                multiplier[u] = smaller(multiplier[u] * smaller(power(w[u]), filled(by->growth)), limit);
        }
        total = ZERO.re;
        for (size_t i = 0; i < q; i++) {
            found[i] = share[i] * root(found[i]);
            total += found[i];
        }
        for (size_t i = 0; i < q; i++)
            share[i] = chosen(total > LEAST, found[i] / larger(total, filled(LEAST)), share[i]);
    }
    release(memory, mark);
}

/* Return whether no weights reach the level, although weights that miss it score above the best elsewhere. */
INLINE int is_limited(float score, float missed, float highest) { return score == 0 && missed > highest; }

#endif
