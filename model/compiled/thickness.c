/* Responses to tones on plates of other thickness: `model.ensemble.thickness` in C. */
#include "lanes.h"

typedef struct {
    int a, r, points;       /* attachments; reduced coordinates; points of the fingers */
    const float *shapes, *at_points; /* (a, r); (points, r) */
    /* By case, of a tone and a thickness: (c, r); (c, a) by tone; (c, a) applied; (c) */
    const float *receptance, *stiffness, *applied, *minus_omega2;
} tones;

/* Values of work space. */
size_t thickness_space(const tones *on) {
    return (size_t)on->a * (on->a + 2) + 2 * on->r + on->points;
}

/* found (c, points): accelerations at the points in cases from first on. */
void thickness_responses(const tones *on, int first, int count, value *work, float *found) {
    const size_t a = on->a, r = on->r;
    int rows[LANES];
    for (int l = 0; l < LANES; l++) rows[l] = first + (l < count ? l : count - 1);
    value *S = work, *Z = S + a * a, *F = Z + a, *g = F + a, *modal = g + r;
    value *responses = modal + r;
    lanes minus_omega2;
    load(g, on->receptance, r, rows);
    load(Z, on->stiffness, a, rows);
    load(F, on->applied, a, rows);
    load_real(&minus_omega2, on->minus_omega2, 1, rows);

    /* (1 + Z A) F = applied, one attachment after the other: none gives energy, the plate is damped. */
    for (size_t i = 0; i < a; i++) {
        for (size_t s = 0; s < r; s++) modal[s] = scaled(g[s], filled(on->shapes[i * r + s]));
        multiply(S + i * a, on->shapes, modal, i + 1, r, 1);
        for (size_t j = 0; j < i; j++) S[j * a + i] = S[i * a + j];
    }
    for (size_t i = 0; i < a; i++) {
        for (size_t j = 0; j < a; j++) S[i * a + j] = times(Z[i], S[i * a + j]);
        S[i * a + i].re += 1;
    }
    for (size_t s = 0; s < a; s++) {
        const value *own = S + s * a;
        value factor = reciprocal(own[s]);
        for (size_t i = s + 1; i < a; i++) {
            value by = times(S[i * a + s], factor);
            for (size_t j = s + 1; j < a; j++) S[i * a + j] = subtract_product(S[i * a + j], by, own[j]);
            F[i] = subtract_product(F[i], by, F[s]);
        }
    }
    for (size_t s = a; s-- > 0;) {
        for (size_t j = s + 1; j < a; j++) F[s] = subtract_product(F[s], S[s * a + j], F[j]);
        F[s] = times(F[s], reciprocal(S[s * a + s]));
    }

    for (size_t s = 0; s < r; s++) {
        value force = ZERO;
        for (size_t i = 0; i < a; i++) {
            force.re += on->shapes[i * r + s] * F[i].re;
            force.im += on->shapes[i * r + s] * F[i].im;
        }
        modal[s] = scaled(times(force, g[s]), minus_omega2);
    }
    multiply(responses, on->at_points, modal, on->points, r, 1);
    store(found + 2 * (size_t)first * on->points, responses, on->points, count);
}
