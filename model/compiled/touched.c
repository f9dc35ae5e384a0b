/* Responses of plates with fingers on them: `model.ensemble.touched_plate` in C. */
#include "fingers.h"

INLINE void cases_of(int *at_rows, int *at_cases, const plates *on, const int *rows, const int *nodes,
                     int first, int count) {
    for (int l = 0; l < LANES; l++) {
        int each = first + (l < count ? l : count - 1);
        at_rows[l] = rows[each], at_cases[l] = rows[each] * on->t + nodes[each];
    }
}

/* Values of work space, for p points. */
size_t touched_fields_space(const plates *on, size_t p) {
    return touched_space(on) + on->r + on->k + p + 2 * on->n + on->b;
}

/* found (count, p): accelerations in cases by ERAs at weights (count, n). */
void touched_fields(const plates *on, int first, int count, const int *rows, const int *nodes, int p,
                    const float *points, value *work, const float *weights, float *found) {
    const size_t n = on->n, b = on->b, k = on->k, r = on->r;
    int at_rows[LANES], at_cases[LANES], given[LANES];
    cases_of(at_rows, at_cases, on, rows, nodes, first, count);
    for (int l = 0; l < LANES; l++) given[l] = first + (l < count ? l : count - 1);
    touched of;
    value *L = put_fingers(&of, on, at_rows, at_cases, work), *held = L + r, *to = held + k;
    value *w = to + p, *drives = w + n, *forces = drives + n;
    load(drives, on->drives, n, at_rows);
    load(w, weights, n, given);

    /* Forces of the ERAs and of the fingers, and what the ERAs add to these. */
    memset(forces, 0, b * sizeof(value));
    for (size_t e = 0; e < n; e++) forces[e] = times(drives[e], w[e]);
    for (size_t i = 0; i < k; i++) {
        value at = ZERO;
        for (size_t e = 0; e < n; e++) at = add_product(at, of.resting[i * b + e], forces[e]);
        held[i] = times(of.D[i], at);
    }
    for (size_t j = 0; j < b; j++) {
        value sum = ZERO;
        for (size_t i = 0; i < k; i++) sum = add_product(sum, held[i], of.at[i * b + j]);
        of.row[j] = sum;
    }
    for (size_t j = 0; j < b; j++)
        for (size_t s = 0; s < b; s++) forces[j] = subtract_product(forces[j], of.Y[j * b + s], of.row[s]);
    for (size_t s = 0; s < r; s++) {
        value sum = ZERO, own = ZERO;
        for (size_t i = 0; i < k; i++) {
            own.re += held[i].re * on->centres[i * r + s];
            own.im += held[i].im * on->centres[i * r + s];
        }
        for (size_t j = 0; j < b; j++) sum = add_product(sum, forces[j], of.T[j * r + s]);
        L[s] = subtract_product(sum, own, of.g[s]);
    }
    multiply(to, points, L, p, r, 1);
    store(found + 2 * (size_t)first * p, to, p, count);
}
