/* Scores of frequencies for the fingers of a question: `model.ensemble.preselection` in C.
 *
 * LANES frequencies at once: a complex value is the real parts at them and then the imaginary parts,
 * and each matrix is one of such values. Vector types are those of GCC and Clang, on any processor.
 */
#include <math.h>
#include <stddef.h>
#include <string.h>

#define LANES 16
#define INLINE static inline __attribute__((always_inline))

#if defined(__x86_64__) && defined(__linux__) && !defined(__clang__)
#define VERSIONS __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define VERSIONS
#endif

typedef float lanes __attribute__((vector_size(LANES * sizeof(float))));

typedef struct {
    lanes re, im;
} value;

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

INLINE value plus(value c, value a, value b) { /* c + a b */
    return (value){c.re + a.re * b.re - a.im * b.im, c.im + a.re * b.im + a.im * b.re};
}

INLINE value minus(value c, value a, value b) { /* c - a b */
    return (value){c.re - a.re * b.re + a.im * b.im, c.im - a.re * b.im - a.im * b.re};
}

INLINE value plus_conjugate(value c, value a, value b) { /* c + conj(a) b */
    return (value){c.re + a.re * b.re + a.im * b.im, c.im + a.re * b.im - a.im * b.re};
}

INLINE value scaled(value a, lanes by) { return (value){a.re * by, a.im * by}; }

INLINE lanes power(value a) { return a.re * a.re + a.im * a.im; }

INLINE lanes inverse(lanes a) { return 1 / a; }

static const value ZERO;

/* found (rows, columns) = a (rows, r), real, times b (columns, r) transposed. */
INLINE void multiply(value *restrict found, const float *restrict a, const value *restrict b,
                     size_t rows, size_t r, size_t columns) {
    for (size_t column = 0; column < columns; column++) {
        size_t row = 0;
        for (; row + 5 <= rows; row += 5) {
            value sum[5] = {ZERO, ZERO, ZERO, ZERO, ZERO};
            const float *at = a + row * r;
            for (size_t j = 0; j < r; j++) {
                value from = b[column * r + j];
                for (int each = 0; each < 5; each++) {
                    sum[each].re += at[each * r + j] * from.re;
                    sum[each].im += at[each * r + j] * from.im;
                }
            }
            for (int each = 0; each < 5; each++) found[(row + each) * columns + column] = sum[each];
        }
        for (; row < rows; row++) {
            value sum = ZERO;
            for (size_t j = 0; j < r; j++) {
                value from = b[column * r + j];
                sum.re += a[row * r + j] * from.re;
                sum.im += a[row * r + j] * from.im;
            }
            found[row * columns + column] = sum;
        }
    }
}

/* Values of work space for k fingers of p points. */
size_t preselection_space(const plate *on, int k, int p) {
    size_t n = on->n, b = on->b, points = (size_t)k * p;
    return points * (b + k + 7 * n) + b * k + n * (n + 2) +
           (points * k * on->r * sizeof(float)) / sizeof(value) + 1;
}

VERSIONS
void preselection_scores(const plate *on, int fingers, int each, const float *points,
                         const float *weights, const value *loads, value *work, lanes *score,
                         lanes *amplitude) {
    const size_t n = on->n, b = on->b, r = on->r, k = fingers, p = each, count = k * p;
    const size_t columns = b + 2 * n, wide = 4 * n;
    value *U = work, *G = U + count * columns, *WU = G + count * k, *H = WU + b * k;
    value *D = H + count * wide, *R = D + count * n, *c = R + n * n, *w = c + n;
    float *products = (float *)(w + n);

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
                sum = plus(sum, on->held[i * b + s], U[j * p * columns + s]);
            WU[i * k + j] = sum;
        }
    for (size_t i = 0; i < count; i++)
        for (size_t j = 0; j < k; j++) {
            value sum = G[i * k + j];
            for (size_t s = 0; s < b; s++) sum = minus(sum, U[i * columns + s], WU[s * k + j]);
            G[i * k + j] = plus(ZERO, sum, loads[j]);
        }

    /* Fields of the ERAs, of a force at each, and two changes of the fields by the thickness. */
    for (size_t i = 0; i < count; i++) {
        for (size_t j = 0; j < 2 * n; j++) {
            value sum = ZERO;
            for (size_t s = 0; s < b; s++)
                sum = plus(sum, U[i * columns + s], on->fields[s * 2 * n + j]);
            H[i * wide + j] = sum;
        }
        memcpy(H + i * wide + 2 * n, U + i * columns + b, 2 * n * sizeof(value));
    }

    /* One finger after the other. Both it and the plate with those before are damped. */
    for (size_t f = 0; f < k; f++) {
        value *own = G + f * p * k, *field = H + f * p * wide;
        value pivot = own[f];
        pivot.re += 1;
        lanes size = inverse(power(pivot));
        value factor = {pivot.re * size, -pivot.im * size};
        for (size_t j = f + 1; j < k; j++) own[j] = plus(ZERO, own[j], factor);
        for (size_t j = 0; j < wide; j++) field[j] = plus(ZERO, field[j], factor);
        for (size_t i = 0; i < count; i++) {
            if (i == f * p) continue;
            value by = G[i * k + f];
            for (size_t j = f + 1; j < k; j++) G[i * k + j] = minus(G[i * k + j], by, own[j]);
            for (size_t j = 0; j < wide; j++) H[i * wide + j] = minus(H[i * wide + j], by, field[j]);
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

    /* Rows of the quiet points: fields, changes by thickness and by the ERAs' damping. */
    for (size_t i = p; i < count; i++) {
        float root = sqrtf(weights[i] / (float)(k - 1));
        value *at = H + i * wide;
        for (size_t j = 0; j < wide; j++) {
            at[j].re *= root;
            at[j].im *= root;
        }
        for (size_t j = 0; j < n; j++) {
            value sum = ZERO;
            for (size_t s = 0; s < n; s++) sum = plus(sum, at[n + s], on->by_damping[s * n + j]);
            D[i * n + j] = sum;
        }
    }
    for (size_t u = 0; u < n; u++)
        for (size_t v = u; v < n; v++) {
            value sum = ZERO;
            for (size_t i = p; i < count; i++) {
                const value *h = H + i * wide, *d = D + i * n;
                sum = plus_conjugate(sum, h[u], h[v]);
                sum = plus_conjugate(sum, d[u], d[v]);
                sum = plus_conjugate(sum, h[2 * n + u], h[2 * n + v]);
                sum = plus_conjugate(sum, h[3 * n + u], h[3 * n + v]);
            }
            R[u * n + v] = sum;
        }
    for (size_t s = 0; s < n; s++) {
        lanes reach = {0};
        for (size_t i = p; i < count; i++) reach += power(H[i * wide + n + s]);
        const value *from = on->by_stiffness + s * n;
        for (size_t u = 0; u < n; u++) {
            value at = scaled(from[u], reach);
            for (size_t v = u; v < n; v++) R[u * n + v] = plus_conjugate(R[u * n + v], at, from[v]);
        }
    }
    for (size_t u = 0; u < n; u++) {
        lanes size = {0};
        for (size_t i = p; i < count; i++) size += power(H[i * wide + u]);
        value *at = R + u * n + u;
        at->re = (at->re + on->gain_variance * size + on->error[u]) * (1 + on->ridge);
    }

    /* w = R^-1 c from the upper triangle. */
    memcpy(w, c, n * sizeof(value));
    for (size_t s = 0; s < n; s++) {
        const value *from = R + s * n;
        lanes pivot = inverse(from[s].re);
        for (size_t u = s + 1; u < n; u++) {
            value by = {from[u].re * pivot, -from[u].im * pivot};
            for (size_t v = u; v < n; v++) R[u * n + v] = minus(R[u * n + v], by, from[v]);
            w[u] = minus(w[u], by, w[s]);
        }
    }
    lanes found = {0}, most = {0};
    for (size_t s = n; s-- > 0;) {
        value own = w[s];
        for (size_t u = s + 1; u < n; u++) own = minus(own, R[s * n + u], w[u]);
        own = scaled(own, inverse(R[s * n + s].re));
        w[s] = own;
        found += c[s].re * own.re + c[s].im * own.im;
        lanes size = power(own);
        for (int l = 0; l < LANES; l++) most[l] = size[l] > most[l] ? size[l] : most[l];
    }
    for (int l = 0; l < LANES; l++) {
        float got = found[l] > 0 ? found[l] : 0;
        ((float *)score)[l] = sqrtf(got);
        ((float *)amplitude)[l] = got / sqrtf(most[l]);
    }
}
