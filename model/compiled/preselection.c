/* Scores of frequencies for the fingers of a question: `model.ensemble.preselection` in C. */
#include "lanes.h"

typedef struct {
    int n, b, r; /* ERAs; these and masses; reduced coordinates */
    float gain_variance, ridge;
    /* (b + 2 n, r): by a force at each attachment; changes of each ERA's field by the thickness */
    const value *modal;
    const value *receptance;                /* (r) */
    const value *fields;                    /* (b, 2 n): forces there by each ERA; by a force there */
    const value *held;                      /* (b, b) */
    const value *by_damping, *by_stiffness; /* (n, n) */
    const lanes *error;                     /* (n) */
} plate;

/* Values of work space for k fingers of p points. */
size_t preselection_space(const plate *on, int k, int p) {
    size_t n = on->n, b = on->b, points = (size_t)k * p;
    return points * (b + k + 10 * n) + b * k + 2 * k + n * (2 * n + 2) +
           (points * k * on->r * sizeof(float)) / sizeof(value) + 1;
}

/* points (k, p, r), weights (k, p), stiffness (f, k) of the fingers; score and amplitude (f). */
void preselection_scores(const plate *on, int first, int some, int fingers, int each, const float *points,
                         const float *weights, const float *stiffness, value *work, float *score,
                         float *amplitude) {
    const size_t n = on->n, b = on->b, r = on->r, k = fingers, p = each, count = k * p;
    const size_t columns = b + 2 * n, wide = 4 * n;
    value *U = work, *G = U + count * columns, *WU = G + count * k, *H = WU + b * k;
    value *X = H + count * wide, *R = X + (4 * count + n) * n + k, *c = R + n * n, *w = c + n, *loads = w + n;
    float *products = (float *)(loads + k);

    int rows[LANES];
    for (int l = 0; l < LANES; l++) rows[l] = first + (l < some ? l : some - 1);
    load(loads, stiffness, k, rows);

    multiply(U, points, on->modal, count, r, columns);
    for (size_t i = 0; i < count; i++)
        for (size_t j = 0; j < k; j++)
            for (size_t s = 0; s < r; s++)
                products[(i * k + j) * r + s] = points[i * r + s] * points[j * p * r + s];
    multiply(G, products, on->receptance, count * k, r, 1);

    /* Less what ERAs and masses hold, U W U^T; then times the fingers' stiffness. */
    for (size_t i = 0; i < b; i++)
        for (size_t j = 0; j < k; j++) {
            value sum = ZERO;
            for (size_t s = 0; s < b; s++)
                sum = add_product(sum, on->held[i * b + s], U[j * p * columns + s]);
            WU[i * k + j] = sum;
        }
    for (size_t i = 0; i < count; i++) {
        row_product(X, U + i * columns, 1, WU, b, k, 0, 0);
        for (size_t j = 0; j < k; j++) {
            value left = {G[i * k + j].re - X[j].re, G[i * k + j].im - X[j].im};
            G[i * k + j] = times(left, loads[j]);
        }
    }

    /* Fields of the ERAs, of a force at each, and two changes of the fields by the thickness. */
    for (size_t i = 0; i < count; i++) {
        row_product(H + i * wide, U + i * columns, 1, on->fields, b, 2 * n, 0, 0);
        memcpy(H + i * wide + 2 * n, U + i * columns + b, 2 * n * sizeof(value));
    }

    /* One finger after the other: none gives energy, and the plate with those before is damped. */
    for (size_t f = 0; f < k; f++) {
        value *own = G + f * p * k, *field = H + f * p * wide;
        value pivot = own[f];
        pivot.re += 1;
        value factor = reciprocal(pivot);
        for (size_t j = f + 1; j < k; j++) own[j] = times(own[j], factor);
        for (size_t j = 0; j < wide; j++) field[j] = times(field[j], factor);
        for (size_t i = 0; i < count; i++) {
            if (i == f * p) continue;
            value by = G[i * k + f];
            for (size_t j = f + 1; j < k; j++) G[i * k + j] = subtract_product(G[i * k + j], by, own[j]);
            for (size_t j = 0; j < wide; j++) H[i * wide + j] = subtract_product(H[i * wide + j], by, field[j]);
        }
    }

    for (size_t j = 0; j < n; j++) {
        value sum = ZERO;
        for (size_t i = 0; i < p; i++) {
            sum.re += weights[i] * H[i * wide + j].re;
            sum.im -= weights[i] * H[i * wide + j].im;
        }
        c[j] = sum;
    }

    /* Rows of the quiet points: fields, changes by the ERAs' damping and by the thickness. */
    value *to = X;
    for (size_t i = p; i < count; i++) {
        lanes share = filled(sqrtf(weights[i] / (float)(k - 1)));
        value *at = H + i * wide;
        for (size_t j = 0; j < wide; j++) at[j] = scaled(at[j], share);
        memcpy(to, at, n * sizeof(value));
        row_product(to + n, at + n, 1, on->by_damping, n, n, 0, 0);
        memcpy(to + 2 * n, at + 2 * n, 2 * n * sizeof(value));
        to += 4 * n;
    }
    for (size_t s = 0; s < n; s++) {
        lanes reach = {0};
        for (size_t i = p; i < count; i++) reach += power(H[i * wide + n + s]);
        reach = root(reach);
        for (size_t j = 0; j < n; j++) *to++ = scaled(on->by_stiffness[s * n + j], reach);
    }
    gram(R, X, 4 * (count - p) + n, n);
    for (size_t u = 0; u < n; u++) {
        lanes size = {0};
        for (size_t i = p; i < count; i++) size += power(H[i * wide + u]);
        value *at = R + u * n + u;
        at->re = (at->re + on->gain_variance * size + on->error[u]) * (1 + on->ridge);
    }

    solve_positive(w, R, c, n);
    lanes found = {0}, most = {0};
    for (size_t s = 0; s < n; s++) {
        found += c[s].re * w[s].re + c[s].im * w[s].im;
        most = larger(most, power(w[s]));
    }
    found = larger(found, ZERO.re);
    most = found / root(most);
    found = root(found);
    store_real(score + first, &found, 1, some);
    store_real(amplitude + first, &most, 1, some);
}
