/* Weights of all ERAs at one frequency for the targets of one content: `model.drive_modes.coherent` in C. */
#ifndef SEARCH_H
#define SEARCH_H

#include "arena.h"

typedef struct {
    int steps, limited;   /* weights; whether each is brought to the level within full stroke */
    float variance, gain; /* of each ERA beyond that of the form; up to full stroke, 0 for none */
    float reserve, growth, most;
} method;

/* How phases of several targets are aligned. */
typedef struct {
    int starts, iterations; /* of every target but the first; from each start */
} phases;

/* LANES frequencies; points: of each quiet form, which count one by one, 0 for none. */
typedef struct {
    size_t n, targets, quiet, points, few, fine;
    phases phases;
    float margin;
    lanes wanted;
    const value *target, *target_power; /* (targets, n), (targets, n, n) */
    const value *const *forms;          /* (quiet) of (n, n) each, whose upper triangle counts */
    const value *at_points;             /* (quiet points, n) fields beside the forms */
    const value *few_fields, *fine_fields; /* (quiet few, n), (quiet fine, n) */
} searched;

/* The best weights (n) that reach the level and their score, the best score of those that miss it, and the bound. */
typedef struct {
    value *weights;
    lanes score, missed, bound;
} best;

static const float LEAST = 1e-30f, TINY = 1e-7f, LEAST_FIELD = 1e-20f, STABLE = 1 + 1e-5f;

INLINE size_t constraints(const searched *on) { return on->quiet * (on->points ? on->points : 1); }

/* w^H R w of a Hermitian form. */
INLINE lanes expected(const value *R, const value *w, size_t n) {
    lanes sum = {0};
    for (size_t i = 0; i < n; i++) {
        value moved = scaled(w[i], R[i * n + i].re * 0.5f);
        for (size_t j = i + 1; j < n; j++) moved = add_product(moved, R[i * n + j], w[j]);
        sum += w[i].re * moved.re + w[i].im * moved.im;
    }
    return 2 * sum;
}

/* sum of a w. */
INLINE value field(const value *a, const value *w, size_t n) {
    value sum = ZERO;
    for (size_t i = 0; i < n; i++) sum = add_product(sum, a[i], w[i]);
    return sum;
}

/* Expected power at each quiet fingertip, or at each of its points. */
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

/* Amplitude at the weakest target, and what is left of it less the margin. */
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

/* R (n, n), upper triangle, of shares of the quiet fingertips. */
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

/* Weights w of largest magnitude 1 of the least power R, which is lost, and their bound. */
SHARED lanes least_power(value *restrict w, value *restrict R, const searched *on, arena *memory) {
    const size_t n = on->n, targets = on->targets;
    const arena mark = *memory;
    value *c = values(memory, n), *some = values(memory, targets > 1 ? n * n : 0);
    size_t starts = 1;
    for (size_t t = 1; t < targets; t++) starts *= on->phases.starts;
    const size_t steps = targets > 1 ? on->phases.iterations : 1;
    value *tried = values(memory, starts * steps * n), *factor = values(memory, targets);
    lanes *reached = take(memory, starts * steps * sizeof(lanes)), highest = {0};
    for (size_t start = 0; start < starts; start++) {
        size_t rest = start;
        for (size_t t = targets; t-- > 0; rest /= on->phases.starts) {
            double angle = t ? 2 * M_PI * (double)(rest % on->phases.starts) / on->phases.starts : 0;
            factor[t] = (value){filled((float)cos(angle)), filled((float)sin(angle))};
            if (!t) break;
        }
        for (size_t step = 0; step < steps; step++) {
            const size_t at = step * starts + start;
            value *own = tried + at * n;
            memset(c, 0, n * sizeof(value));
            for (size_t t = 0; t < targets; t++)
                for (size_t u = 0; u < n; u++) c[u] = add_conjugate_product(c[u], on->target[t * n + u], factor[t]);
            if (targets > 1) memcpy(some, R, n * n * sizeof(value));
            solve_positive(own, targets > 1 ? some : R, c, n);
            if (targets == 1) {
                value sum = ZERO;
                for (size_t u = 0; u < n; u++) sum = add_conjugate_product(sum, c[u], own[u]);
                reached[at] = root(root(power(sum)));
                break;
            }
            lanes weakest = filled(INFINITY), mean = {0};
            value at_targets[targets];
            for (size_t t = 0; t < targets; t++) {
                at_targets[t] = field(on->target + t * n, own, n);
                lanes size = larger(root(power(at_targets[t])), filled(LEAST_FIELD));
                weakest = smaller(weakest, size), mean += size / (float)targets;
            }
            for (size_t t = 0; t < targets; t++) {
                lanes size = larger(root(power(at_targets[t])), filled(LEAST_FIELD));
                lanes lacking = root(power(factor[t])) * root(mean / size) / size;
                factor[t] = scaled(at_targets[t], lacking);
            }
            reached[at] = weakest / root(larger(expected(R, own, n), filled(LEAST)));
        }
    }
    for (size_t at = 0; at < starts * steps; at++) highest = larger(highest, reached[at]);
    mask open = highest == highest;
    lanes bound = {0}, most = {0};
    for (size_t at = 0; at < starts * steps; at++) {
        mask chosen_here = open & (reached[at] >= highest * (2 - STABLE));
        bound = chosen(chosen_here, reached[at], bound);
        for (size_t u = 0; u < n; u++) {
            w[u].re = chosen(chosen_here, tried[at * n + u].re, at ? w[u].re : ZERO.re);
            w[u].im = chosen(chosen_here, tried[at * n + u].im, at ? w[u].im : ZERO.re);
        }
        open &= ~chosen_here;
    }
    for (size_t u = 0; u < n; u++) most = larger(most, power(w[u]));
    lanes size = inverse(larger(root(most), filled(LEAST)));
    for (size_t u = 0; u < n; u++) w[u] = scaled(w[u], size);
    release(memory, mark);
    return bound;
}

/* The best of as many weights as a method has steps. */
SHARED void search(best *to, const searched *on, const method *by, arena *memory) {
    const size_t n = on->n, q = constraints(on);
    const arena mark = *memory;
    value *w = values(memory, n), *fitting = values(memory, n), *R = values(memory, n * n);
    lanes *share = take(memory, q * sizeof(lanes)), *found = take(memory, q * sizeof(lanes));
    lanes *multiplier = take(memory, n * sizeof(lanes)), limit = {0};
    for (size_t i = 0; i < q; i++) share[i] = filled(1 / (float)q);
    for (size_t i = 0; i < n; i++) multiplier[i] = to->weights[i].re = to->weights[i].im = ZERO.re;
    to->score = to->missed = ZERO.re, to->bound = filled(INFINITY);

    for (int step = 0; step < by->steps; step++) {
        weighted(R, on, share);
        for (size_t u = 0; u < n; u++)
            R[u * n + u] = (value){R[u * n + u].re * (1 + by->variance) + multiplier[u], ZERO.im};
        to->bound = smaller(to->bound, least_power(w, R, on, memory));
        lanes least;
        if (by->limited) {
            lanes amp = amplitude(&least, on, w);
            lanes gain = by->reserve * on->wanted / larger(least, 0.1f * amp + LEAST_FIELD);
            for (size_t u = 0; u < n; u++) w[u] = scaled(w[u], gain);
        }
        const float full = by->gain;
        for (size_t u = 0; u < n; u++)
            fitting[u] = full ? scaled(w[u], inverse(larger(root(power(w[u])), filled(1 / full)))) : w[u];

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

/* Whether no weights reach the level where those that miss it are better than the best that reach it. */
INLINE int is_limited(float score, float missed, float highest) { return score == 0 && missed > highest; }

#endif
