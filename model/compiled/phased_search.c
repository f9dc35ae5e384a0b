/* Weights of all ERAs at one frequency for one target: `model.drive_modes.coherent` in C. */
#include "lanes.h"

typedef struct {
    int n, q, few, fine; /* ERAs; quiet fingertips; points of each, 0 for none */
    float wanted, margin;
    const float *targets, *target_power; /* (f, n), (f, n, n) */
    const float *quiet, *threshold;      /* (f, q, n, n), (f) */
    const float *few_fields, *fine_fields; /* (f, q, points, n) */
} forms;

typedef struct {
    int steps, limited;   /* weights; whether each is brought to the level within full stroke */
    float variance, gain; /* of each ERA beyond that of the form; up to full stroke, 0 for none */
    float reserve, growth, most;
} method;

static const float LEAST = 1e-30f, TINY = 1e-7f, LEAST_FIELD = 1e-20f;

/* Values of work space. */
size_t phased_search_space(const forms *on) {
    size_t n = on->n, q = on->q, points = q * (on->few + on->fine);
    return n * (6 + (2 + q) * n + points) + 2 * q + n;
}

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

typedef struct {
    size_t n, q, few, fine;
    lanes wanted;
    float margin;
    const value *target, *target_power, *quiet, *few_fields, *fine_fields;
} block;

/* Expected power at each quiet fingertip. */
SHARED void quiet_power(lanes *restrict found, const block *on, const value *w) {
    size_t n = on->n;
    for (size_t q = 0; q < on->q; q++) {
        found[q] = expected(on->quiet + q * n * n, w, n);
        if (!on->few) continue;
        lanes mean = {0}, loudest = {0};
        for (size_t i = q * on->few; i < (q + 1) * on->few; i++)
            mean += power(field(on->few_fields + i * n, w, n));
        for (size_t i = q * on->fine; i < (q + 1) * on->fine; i++)
            loudest = larger(loudest, power(field(on->fine_fields + i * n, w, n)));
        found[q] += larger(loudest - mean, ZERO.re);
    }
}

/* Amplitude at the target, and what is left of it less the margin. */
SHARED lanes amplitude(lanes *least, const block *on, const value *w) {
    lanes size = power(field(on->target, w, on->n)), found = root(size);
    *least = found;
    if (on->margin != 0)
        *least -= on->margin * root(expected(on->target_power, w, on->n) - size);
    return found;
}

INLINE lanes loudest_of(const lanes *power, size_t count) {
    lanes found = power[0];
    for (size_t i = 1; i < count; i++) found = larger(found, power[i]);
    return found;
}

/* At rows (count): the best weights (count, n) that reach the level and their score, the best score
 * of those that miss it, and the bound; of as many weights as steps. */
void phased_search(const forms *from, const method *by, const int *indices, int count, value *work,
                   float *weights, float *scores, float *missed, float *bounds) {
    const size_t n = from->n, q = from->q, few = from->few, fine = from->fine;
    value *c = work, *w = c + n, *fitting = w + n, *best = fitting + n, *target = best + n;
    value *P = target + n, *R = P + n * n, *Q = R + n * n;
    value *fields = Q + q * n * n, *points = fields + q * few * n;
    lanes *share = (lanes *)(points + q * fine * n), *found = share + q, *own = found + q;
    lanes *multiplier = own + q;
    for (int first = 0; first < count; first += LANES) {
        int rows[LANES], some = count - first < LANES ? count - first : LANES;
        for (int l = 0; l < LANES; l++) rows[l] = indices[first + (l < some ? l : some - 1)];
        lanes wanted;
        load_real(&wanted, from->threshold, 1, rows);
        load(target, from->targets, n, rows);
        load(P, from->target_power, n * n, rows);
        load(Q, from->quiet, q * n * n, rows);
        if (few) load(fields, from->few_fields, q * few * n, rows);
        if (few) load(points, from->fine_fields, q * fine * n, rows);
        const block on = {n, q, few, fine, wanted * from->wanted, from->margin, target, P, Q, fields, points};
        for (size_t i = 0; i < n; i++) c[i] = (value){target[i].re, -target[i].im};
        for (size_t i = 0; i < q; i++) share[i] = filled(1 / (float)q);
        for (size_t i = 0; i < n; i++) multiplier[i] = best[i].re = best[i].im = ZERO.re;
        lanes score = {0}, miss = {0}, bound = filled(INFINITY), limit = {0};

        for (int step = 0; step < by->steps; step++) {
            memset(R, 0, n * n * sizeof(value));
            for (size_t i = 0; i < q; i++)
                for (size_t u = 0; u < n; u++)
                    for (size_t v = u; v < n; v++) {
                        value *to = R + u * n + v;
                        const value *own_form = Q + (i * n + u) * n + v;
                        to->re += share[i] * own_form->re;
                        to->im += share[i] * own_form->im;
                    }
            for (size_t u = 0; u < n; u++)
                R[u * n + u].re = R[u * n + u].re * (1 + by->variance) + multiplier[u];
            solve_positive(w, R, c, n);
            value reached = ZERO;
            lanes most = {0};
            for (size_t u = 0; u < n; u++) {
                reached = add_conjugate_product(reached, c[u], w[u]);
                most = larger(most, power(w[u]));
            }
            bound = smaller(bound, root(root(power(reached))));
            lanes size = inverse(larger(root(most), filled(LEAST)));
            lanes least;
            for (size_t u = 0; u < n; u++) w[u] = scaled(w[u], size);
            if (by->limited) {
                lanes amp = amplitude(&least, &on, w);
                lanes gain = by->reserve * on.wanted / larger(least, 0.1f * amp + LEAST_FIELD);
                for (size_t u = 0; u < n; u++) w[u] = scaled(w[u], gain);
            }
            float full = by->gain;
            for (size_t u = 0; u < n; u++)
                fitting[u] = full ? scaled(w[u], inverse(larger(root(power(w[u])), filled(1 / full)))) : w[u];

            quiet_power(found, &on, fitting);
            lanes amp = amplitude(&least, &on, fitting);
            lanes power_of_quiet = larger(loudest_of(found, q), filled(LEAST)) + TINY * (amp * amp);
            lanes robust = amp / root(power_of_quiet);
            mask reaches = least >= on.wanted;
            miss = larger(miss, chosen(reaches, ZERO.re, robust));
            mask better = reaches & (robust > score);
            score = chosen(better, robust, score);
            for (size_t u = 0; u < n; u++) {
                best[u].re = chosen(better, fitting[u].re, best[u].re);
                best[u].im = chosen(better, fitting[u].im, best[u].im);
            }
            if (step + 1 == by->steps) break;

            if (by->limited) {
                lanes total = {0};
                for (size_t u = 0; u < n; u++) total += power(w[u]);
                if (step == 0) {
                    quiet_power(own, &on, w);
                    lanes start = loudest_of(own, q) / larger(total, filled(LEAST));
                    for (size_t u = 0; u < n; u++) multiplier[u] = start;
                    limit = start * by->most;
                }
                for (size_t u = 0; u < n; u++)
                    multiplier[u] = smaller(multiplier[u] * smaller(power(w[u]), filled(by->growth)), limit);
            }
            if (q > 1) {
                lanes total = {0};
                for (size_t i = 0; i < q; i++) {
                    found[i] = share[i] * root(found[i]);
                    total += found[i];
                }
                for (size_t i = 0; i < q; i++) {
                    lanes moved = found[i] / larger(total, filled(LEAST));
                    share[i] = chosen(total > LEAST, moved, share[i]);
                }
            }
        }
        store(weights + 2 * first * n, best, n, some);
        store_real(scores + first, &score, 1, some);
        store_real(missed + first, &miss, 1, some);
        store_real(bounds + first, &bound, 1, some);
    }
}
