/* The plate with fingers on it: `model.ensemble.contact_forms` in C, whose symbols are used. */
#include "lanes.h"

typedef struct {
    int n, b, k, p, r; /* ERAs; these and masses; fingers; points of each; reduced coordinates */
    int deviating;     /* plates of other thickness */
    float gain_variance, ridge;
    const float *shapes, *points, *weights; /* (b + k, r); (k p, r); (k p) */
    const float *receptance, *others;       /* (f, r); (f, deviating, r) */
    const float *minus_omega2, *error;      /* (f); (f, n) */
    const float *stiffness, *drives, *strokes, *by_damping; /* (f, b + k); (f, n) */
    const float *changes;                                   /* (f, n + k), of ERAs and fingers */
    /* Found: (f, a, a); (f, a, n); (f, a, n); (f, k p, n); (f, k, n, n) */
    float *inverse, *forces, *motion, *fields, *power;
} contacts;

/* Values of work space. */
size_t contact_forms_space(const contacts *on) {
    size_t n = on->n, k = on->k, a = on->b + k, j = n + k, at = k * on->p, every = a + at;
    size_t complex_values = (2 + on->deviating) * on->r + every * a + a * a + 3 * a * n +
                            (2 + on->deviating) * at * n + at * a + j * n + k * n * n +
                            ((2 + on->deviating) * on->p + j) * n + n * n + a + 3 * n + j;
    size_t real_values = at * j + n;
    return complex_values + real_values / 2 + 1;
}

/* B (a + k p, a) of receptance g: from every attachment and point to each attachment. */
INLINE void between(value *restrict B, value *restrict modal, const value *g, const contacts *on) {
    const size_t a = on->b + on->k, p = on->p, r = on->r;
    for (size_t i = 0; i < a; i++) {
        for (size_t s = 0; s < r; s++) modal[s] = scaled(g[s], filled(on->shapes[i * r + s]));
        multiply(B + i * a, on->shapes, modal, i + 1, r, 1);
        for (size_t j = 0; j < i; j++) B[j * a + i] = B[i * a + j];
    }
    for (size_t i = 0; i < on->k * p; i++) {
        value *found = B + (a + i) * a;
        if (i % p == 0) { /* a finger's centre is an attachment */
            memcpy(found, B + (on->b + i / p) * a, a * sizeof(value));
            continue;
        }
        for (size_t s = 0; s < r; s++) modal[s] = scaled(g[s], filled(on->points[i * r + s]));
        multiply(found, on->shapes, modal, a, r, 1);
    }
}

/* K = (1 + Z A)^-1 (a, a), one attachment after the other: none gives energy, the plate is damped. */
INLINE void invert(value *restrict K, const value *A, const value *Z, size_t a) {
    for (size_t i = 0; i < a; i++)
        for (size_t j = 0; j < a; j++) K[i * a + j] = times(Z[i], A[i * a + j]);
    for (size_t i = 0; i < a; i++) K[i * a + i].re += 1;
    for (size_t s = 0; s < a; s++) {
        value *own = K + s * a, pivot = own[s];
        value factor = reciprocal(pivot);
        own[s] = (value){filled(1), ZERO.im};
        for (size_t j = 0; j < a; j++) own[j] = times(own[j], factor);
        for (size_t i = 0; i < a; i++) {
            if (i == s) continue;
            value by = K[i * a + s];
            K[i * a + s] = ZERO;
            for (size_t j = 0; j < a; j++) K[i * a + j] = subtract_product(K[i * a + j], by, own[j]);
        }
    }
}

void contact_forms(const contacts *on, int first, int count, value *work) {
    const size_t n = on->n, b = on->b, k = on->k, p = on->p, r = on->r, a = b + k;
    const size_t every = a + k * p, at = k * p, others = on->deviating, j = n + k;
    int rows[LANES];
    for (int l = 0; l < LANES; l++) rows[l] = first + (l < count ? l : count - 1);

    value *g = work, *B = g + (1 + others) * r, *K = B + every * a, *F = K + a * a;
    value *u = F + a * n, *h = u + a * n, *T = h + (2 + others) * at * n, *moved = T + at * a;
    value *R = moved + j * n, *X = R + k * n * n, *Z = X + ((2 + others) * p + j) * n;
    value *drives = Z + a, *strokes = drives + n, *by_damping = strokes + n, *changes = by_damping + n;
    value *damped = changes + j, *wide = damped + n * n, *modal = wide + a * n;
    lanes *reach = (lanes *)(modal + r), *error = reach + at * j;

    load(g, on->receptance, r, rows);
    load(g + r, on->others, others * r, rows);
    load(Z, on->stiffness, a, rows);
    load(drives, on->drives, n, rows);
    load(strokes, on->strokes, n, rows);
    load(by_damping, on->by_damping, n, rows);
    load(changes, on->changes, j, rows);
    load_real(error, on->error, n, rows);
    lanes minus_omega2;
    load_real(&minus_omega2, on->minus_omega2, 1, rows);

    for (size_t plate = 0; plate <= others; plate++) {
        between(B, modal, g + plate * r, on);
        invert(K, B, Z, a);
        for (size_t i = 0; i < a; i++)
            for (size_t e = 0; e < n; e++) F[i * n + e] = times(K[i * a + e], drives[e]);
        value *fields = plate ? h + (1 + plate) * at * n : h;
        for (size_t i = 0; i < a * n; i++) wide[i] = scaled(F[i], minus_omega2);
        product(fields, B + a * a, a, wide, at, a, n);
        if (plate) {
            lanes factor = filled(sqrtf(1 / (float)others));
            for (size_t i = 0; i < at * n; i++) {
                fields[i].re = (fields[i].re - h[i].re) * factor;
                fields[i].im = (fields[i].im - h[i].im) * factor;
            }
            continue;
        }
        product(u, B, a, F, a, a, n);
        for (size_t i = 0; i < a * n; i++) u[i] = scaled(u[i], filled(-1));
        for (size_t e = 0; e < n; e++) u[e * n + e] = (value){u[e * n + e].re + strokes[e].re,
                                                              u[e * n + e].im + strokes[e].im};
        store(on->inverse + 2 * first * a * a, K, a * a, count);
        store(on->forces + 2 * first * a * n, F, a * n, count);
        store(on->motion + 2 * first * a * n, u, a * n, count);
        for (size_t i = 0; i < a * a; i++) K[i] = scaled(K[i], minus_omega2);
        product(T, B + a * a, a, K, at, a, a);
        for (size_t e = 0; e < n; e++)
            for (size_t i = 0; i < n; i++) damped[e * n + i] = times(by_damping[e], u[e * n + i]);
        product(h + at * n, T, a, damped, at, n, n);
        for (size_t i = 0; i < at; i++)
            for (size_t s = 0; s < j; s++) reach[i * j + s] = power(T[i * a + (s < n ? s : b + s - n)]);
        for (size_t s = 0; s < j; s++)
            for (size_t e = 0; e < n; e++)
                moved[s * n + e] = times(changes[s], u[(s < n ? s : b + s - n) * n + e]);
    }
    store(on->fields + 2 * first * at * n, h, at * n, count);

    /* Forms of the mean over each fingertip, of the rows at its points and of what is uncertain. */
    for (size_t finger = 0; finger < k; finger++) {
        value *form = R + finger * n * n, *to = X;
        for (size_t i = finger * p; i < (finger + 1) * p; i++) {
            lanes share = filled(sqrtf(on->weights[i]));
            for (size_t part = 0; part < 2 + others; part++)
                for (size_t e = 0; e < n; e++) *to++ = scaled(h[(part * at + i) * n + e], share);
        }
        for (size_t s = 0; s < j; s++) {
            lanes share = {0};
            for (size_t i = finger * p; i < (finger + 1) * p; i++)
                share += on->weights[i] * reach[i * j + s];
            share = root(share);
            for (size_t e = 0; e < n; e++) *to++ = scaled(moved[s * n + e], share);
        }
        gram(form, X, (2 + others) * p + j, n);
        lanes trace = {0};
        for (size_t e = 0; e < n; e++) {
            lanes size = {0};
            for (size_t i = finger * p; i < (finger + 1) * p; i++)
                size += on->weights[i] * power(h[i * n + e]);
            form[e * n + e].re += on->gain_variance * size + error[e];
            trace += form[e * n + e].re;
        }
        for (size_t e = 0; e < n; e++) {
            form[e * n + e] = (value){form[e * n + e].re + trace * (on->ridge / (float)n), ZERO.im};
            for (size_t v = 0; v < e; v++)
                form[e * n + v] = (value){form[v * n + e].re, -form[v * n + e].im};
        }
    }
    store(on->power + 2 * first * k * n * n, R, k * n * n, count);
}
