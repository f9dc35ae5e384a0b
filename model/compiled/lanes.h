/* Vector arithmetic on LANES cases, for example frequencies. The build sets LANES to the width of the
 * processor's registers.
 *
 * A complex value consists of the real parts of all lanes, then the imaginary parts. A matrix is an array
 * of such values. The vector types are those of GCC and Clang, for any processor. Arrays of numpy contain
 * one case after another; `load` and `store` convert them.
 */
#ifndef LANES_H
#define LANES_H

#include <math.h>
#include <stddef.h>
#include <string.h>

#define INLINE static inline __attribute__((always_inline))

/* A function that is called instead of inlined. */
#define SHARED static __attribute__((unused, noinline))

typedef float lanes __attribute__((vector_size(LANES * sizeof(float))));

typedef int mask __attribute__((vector_size(LANES * sizeof(int))));

typedef struct {
    lanes re, im;
} value;

INLINE value times(value a, value b) {
    return (value){.re = a.re * b.re - a.im * b.im, .im = a.re * b.im + a.im * b.re};
}

INLINE value add_product(value c, value a, value b) { /* c + a b */
    return (value){.re = c.re + a.re * b.re - a.im * b.im, .im = c.im + a.re * b.im + a.im * b.re};
}

INLINE value subtract_product(value c, value a, value b) { /* c - a b */
    return (value){.re = c.re - a.re * b.re + a.im * b.im, .im = c.im - a.re * b.im - a.im * b.re};
}

INLINE value add_conjugate_product(value c, value a, value b) { /* c + conj(a) b */
    return (value){.re = c.re + a.re * b.re + a.im * b.im, .im = c.im + a.re * b.im - a.im * b.re};
}

INLINE value scaled(value a, lanes by) { return (value){.re = a.re * by, .im = a.im * by}; }

INLINE lanes power(value a) { return a.re * a.re + a.im * a.im; }

INLINE lanes inverse(lanes a) { return 1 / a; }

INLINE value reciprocal(value a) {
    lanes size = inverse(power(a));
    return (value){.re = a.re * size, .im = -a.im * size};
}

INLINE lanes filled(float a) { return a - (lanes){0}; }

INLINE lanes chosen(mask where, lanes a, lanes b) { /* a where the mask is set, otherwise b */
    return (lanes)((where & (mask)a) | (~where & (mask)b));
}

INLINE lanes larger(lanes a, lanes b) {
    for (int l = 0; l < LANES; l++) a[l] = a[l] > b[l] ? a[l] : b[l];
    return a;
}

INLINE lanes smaller(lanes a, lanes b) {
    for (int l = 0; l < LANES; l++) a[l] = a[l] < b[l] ? a[l] : b[l];
    return a;
}

INLINE lanes root(lanes a) { /* 0 for values that rounding made negative */
    lanes found;
    for (int l = 0; l < LANES; l++) found[l] = sqrtf(a[l] > 0 ? a[l] : 0);
    return found;
}

static const value ZERO;

#if LANES == 4
#define LOW 0, 4, 1, 5
#define HIGH 2, 6, 3, 7
#elif LANES == 8
#define LOW 0, 8, 1, 9, 2, 10, 3, 11
#define HIGH 4, 12, 5, 13, 6, 14, 7, 15
#else
#define LOW 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23
#define HIGH 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31
#endif
#ifdef __clang__
#define mixed(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define mixed(a, b, ...) __builtin_shuffle(a, b, (mask){__VA_ARGS__})
#endif

/* Transpose a matrix of LANES rows: each step interleaves the upper and the lower half of the rows. */
INLINE void transpose(lanes *rows) {
#pragma GCC unroll 4
    for (int step = 1; step < LANES; step *= 2) {
        lanes next[LANES];
#pragma GCC unroll 8
        for (int i = 0; i < LANES / 2; i++) {
            lanes a = rows[i], b = rows[i + LANES / 2];
            next[2 * i] = mixed(a, b, LOW), next[2 * i + 1] = mixed(a, b, HIGH);
        }
        memcpy(rows, next, sizeof next);
    }
}

/* Load rows of an array (f, width) of complex values. */
SHARED void load(value *restrict to, const float *from, size_t width, const int *rows) {
    size_t i = 0;
    for (; i + LANES / 2 <= width; i += LANES / 2) {
        lanes some[LANES];
#pragma GCC unroll 16
        for (size_t l = 0; l < LANES; l++) memcpy(some + l, from + 2 * (width * rows[l] + i), sizeof *some);
        transpose(some);
        memcpy(to + i, some, sizeof some);
    }
    for (; i < width; i++)
        for (size_t l = 0; l < LANES; l++) {
            const float *at = from + 2 * (width * rows[l] + i);
            to[i].re[l] = at[0], to[i].im[l] = at[1];
        }
}

/* Load rows of an array (f, width) of real values. */
INLINE void load_real(lanes *restrict to, const float *from, size_t width, const int *rows) {
    for (size_t l = 0; l < LANES; l++)
        for (size_t i = 0; i < width; i++) ((float *)to)[LANES * i + l] = from[width * rows[l] + i];
}

/* Store the first count lanes as rows of an array (count, width) of complex values. */
SHARED void store(float *to, const value *restrict from, size_t width, size_t count) {
    size_t i = 0;
    for (; i + LANES / 2 <= width; i += LANES / 2) {
        lanes some[LANES];
        memcpy(some, from + i, sizeof some);
        transpose(some);
        for (size_t l = 0; l < count; l++) memcpy(to + 2 * (width * l + i), some + l, sizeof *some);
    }
    for (; i < width; i++)
        for (size_t l = 0; l < count; l++) {
            float *at = to + 2 * (width * l + i);
            at[0] = from[i].re[l], at[1] = from[i].im[l];
        }
}

/* Store the first count lanes as rows of an array (count, width) of real values. */
INLINE void store_real(float *to, const lanes *restrict from, size_t width, size_t count) {
    for (size_t l = 0; l < count; l++)
        for (size_t i = 0; i < width; i++) to[width * l + i] = ((const float *)from)[LANES * i + l];
}

/* found (rows) = a (rows, r) b (r) with real a. step: distance between results. */
SHARED void multiply_into(value *restrict found, size_t step, const float *restrict a,
                          const value *restrict b, size_t rows, size_t r) {
    size_t row = 0;
    for (; row < rows && rows >= 4; row += 4) {
        if (row + 4 > rows) row = rows - 4; /* the last four rows again: one row takes as long as four */
        const float *a0 = a + row * r, *a1 = a0 + r, *a2 = a1 + r, *a3 = a2 + r;
        value s0 = ZERO, s1 = ZERO, s2 = ZERO, s3 = ZERO; /* single variables, because the compiler keeps no array in
                                                           * registers */
        for (size_t j = 0; j < r; j++) {
            value from = b[j];
            s0.re += a0[j] * from.re, s0.im += a0[j] * from.im;
            s1.re += a1[j] * from.re, s1.im += a1[j] * from.im;
            s2.re += a2[j] * from.re, s2.im += a2[j] * from.im;
            s3.re += a3[j] * from.re, s3.im += a3[j] * from.im;
        }
        found[row * step] = s0, found[(row + 1) * step] = s1;
        found[(row + 2) * step] = s2, found[(row + 3) * step] = s3;
    }
    for (; row < rows; row++) {
        value sum = ZERO;
        for (size_t j = 0; j < r; j++) {
            sum.re += a[row * r + j] * b[j].re;
            sum.im += a[row * r + j] * b[j].im;
        }
        found[row * step] = sum;
    }
}

/* found (columns) = b (columns, r) a (r) with real a. */
SHARED void multiply_row(value *restrict found, const float *restrict a, const value *restrict b, size_t r, size_t columns) {
    size_t column = 0;
    for (; column < columns && columns >= 4; column += 4) {
        if (column + 4 > columns) column = columns - 4; /* as in `multiply_into` */
        const value *b0 = b + column * r, *b1 = b0 + r, *b2 = b1 + r, *b3 = b2 + r;
        value s0 = ZERO, s1 = ZERO, s2 = ZERO, s3 = ZERO;
        for (size_t j = 0; j < r; j++) {
            s0.re += a[j] * b0[j].re, s0.im += a[j] * b0[j].im;
            s1.re += a[j] * b1[j].re, s1.im += a[j] * b1[j].im;
            s2.re += a[j] * b2[j].re, s2.im += a[j] * b2[j].im;
            s3.re += a[j] * b3[j].re, s3.im += a[j] * b3[j].im;
        }
        found[column] = s0, found[column + 1] = s1, found[column + 2] = s2, found[column + 3] = s3;
    }
    for (; column < columns; column++) multiply_into(found + column, 1, a, b + column * r, 1, r);
}

/* found (rows, columns) = a (rows, r) b^T with real a and b (columns, r). */
INLINE void multiply(value *found, const float *a, const value *b, size_t rows, size_t r, size_t columns) {
    for (size_t row = 0; row < rows && rows < 4; row++) multiply_row(found + row * columns, a + row * r, b, r, columns);
    for (size_t column = 0; column < columns && rows >= 4; column++)
        multiply_into(found + column, columns, a, b + column * r, rows, r);
}

/* found (columns) = a (inner) b (inner, columns), or conj(a) b, at least from column `first` on. step: distance
 * between the values of a. */
SHARED void row_product(value *restrict found, const value *a, size_t step, const value *b, size_t inner,
                        size_t columns, size_t first, int conjugated) {
    const float sign = conjugated ? -1 : 1;
    size_t j = first;
    for (; j < columns && columns >= 4; j += 4) {
        if (j + 4 > columns) j = columns - 4; /* as in `multiply_into` */
        value s0 = ZERO, s1 = ZERO, s2 = ZERO, s3 = ZERO;
        for (size_t s = 0; s < inner; s++) {
            const value *from = b + s * columns + j;
            value by = a[s * step];
            by.im *= sign;
            s0 = add_product(s0, by, from[0]), s1 = add_product(s1, by, from[1]);
            s2 = add_product(s2, by, from[2]), s3 = add_product(s3, by, from[3]);
        }
        found[j] = s0, found[j + 1] = s1, found[j + 2] = s2, found[j + 3] = s3;
    }
    for (; j < columns; j++) {
        value sum = ZERO;
        for (size_t s = 0; s < inner; s++) {
            value by = a[s * step];
            by.im *= sign;
            sum = add_product(sum, by, b[s * columns + j]);
        }
        found[j] = sum;
    }
}

/* found (rows, columns) = a (rows, inner) b (inner, columns). width: distance between the rows of a. */
SHARED void product(value *restrict found, const value *a, size_t width, const value *b, size_t rows,
                    size_t inner, size_t columns) {
    for (size_t i = 0; i < rows; i++)
        row_product(found + i * columns, a + i * width, 1, b, inner, columns, 0, 0);
}

/* R (n, n) = X^H X of X (rows, n); at least the upper triangle. */
SHARED void gram(value *restrict R, const value *X, size_t rows, size_t n) {
    for (size_t i = 0; i < n; i++) row_product(R + i * n, X + i, n, X, rows, n, i, 1);
}

/* Factorize a positive definite Hermitian R (n, n) in place, from its upper triangle. The inverse of each pivot is
 * stored as the imaginary part of the diagonal. */
SHARED void factorize_hermitian(value *restrict R, size_t n) {
    for (size_t s = 0; s < n; s++) {
        const value *from = R + s * n;
        const lanes pivot = inverse(from[s].re);
        for (size_t u = s + 1; u < n; u++) {
            value by = {.re = from[u].re * pivot, .im = -from[u].im * pivot};
            for (size_t v = u; v < n; v++) R[u * n + v] = subtract_product(R[u * n + v], by, from[v]);
        }
        R[s * n + s].im = pivot;
    }
}

/* x = R^-1 x with R from `factorize_hermitian`. */
SHARED void solve_hermitian(value *restrict x, const value *restrict R, size_t n) {
    for (size_t s = 0; s < n; s++)
        for (size_t u = s + 1; u < n; u++) {
            const value from = R[s * n + u];
            const lanes pivot = R[s * n + s].im;
            x[u] = subtract_product(x[u], (value){.re = from.re * pivot, .im = -from.im * pivot}, x[s]);
        }
    for (size_t s = n; s-- > 0;) {
        value own = x[s];
        for (size_t u = s + 1; u < n; u++) own = subtract_product(own, R[s * n + u], x[u]);
        x[s] = scaled(own, R[s * n + s].im);
    }
}

#endif
