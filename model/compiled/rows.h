/* Products and linear equations of complex matrices of a single case: lanes are columns (in lanes.h, lanes are cases). */
#ifndef ROWS_H
#define ROWS_H

#include "arena.h"

typedef float loose __attribute__((vector_size(LANES * sizeof(float)), aligned(4), may_alias));

/* A matrix with `width` complex values per row; real and imaginary parts are separate arrays. */
typedef struct {
    float *re, *im;
    size_t width;
} matrix;

INLINE size_t whole(size_t count) { return (count + LANES - 1) / LANES * LANES; }

/* Return a row width for which a column does not map to a few sets of the processor's cache. */
INLINE size_t apart(size_t width) { return width + LANES; }

static matrix zeros(size_t rows, size_t width, arena *memory) {
    const size_t size = rows * width + 4 * LANES; /* whole registers are read and written beyond the last value */
    float *at = floats(memory, 2 * size);
    memset(at, 0, 2 * size * sizeof(float));
    return (matrix){.re = at, .im = at + size, .width = width};
}

INLINE value at(const matrix *of, size_t i) {
    return (value){.re = *(const loose *)(of->re + i), .im = *(const loose *)(of->im + i)};
}

INLINE void put(const matrix *to, size_t i, value a) { *(loose *)(to->re + i) = a.re, *(loose *)(to->im + i) = a.im; }

INLINE value one(const matrix *of, size_t i) { return (value){.re = filled(of->re[i]), .im = filled(of->im[i])}; }

INLINE value conjugate(value a) { return (value){.re = a.re, .im = -a.im}; }

INLINE float sum(lanes a) {
    float parts[LANES];
    memcpy(parts, &a, sizeof parts);
    for (int half = LANES / 2; half; half /= 2)
        for (int l = 0; l < half; l++) parts[l] += parts[l + half];
    return parts[0];
}

/* Add sign times X^H X, over the first `rows` rows of X, to C at rows i to i + 3 and LANES columns from j on. */
INLINE void add_gram(const matrix *C, const matrix *X, size_t rows, size_t i, size_t j, float sign) {
    value s0 = ZERO, s1 = ZERO, s2 = ZERO, s3 = ZERO; /* single variables, because the compiler keeps no array in
                                                       * registers */
    for (size_t row = 0; row < rows; row++) {
        const float *re = X->re + row * X->width + i, *im = X->im + row * X->width + i;
        const value from = at(X, row * X->width + j);
        s0.re += re[0] * from.re + im[0] * from.im, s0.im += re[0] * from.im - im[0] * from.re;
        s1.re += re[1] * from.re + im[1] * from.im, s1.im += re[1] * from.im - im[1] * from.re;
        s2.re += re[2] * from.re + im[2] * from.im, s2.im += re[2] * from.im - im[2] * from.re;
        s3.re += re[3] * from.re + im[3] * from.im, s3.im += re[3] * from.im - im[3] * from.re;
    }
    const value found[4] = {s0, s1, s2, s3};
    for (size_t q = 0; q < 4; q++) {
        const size_t to = (i + q) * C->width + j;
        const value old = at(C, to);
        put(C, to, (value){.re = old.re + sign * found[q].re, .im = old.im + sign * found[q].im});
    }
}

/* Replace the upper triangle of A (n, n) by R with R^H R = A (Cholesky); n is a multiple of LANES. The diagonal of R
 * is set to zero, and its inverse stored in `inverted`. Entries below the diagonal are ignored. Pivots are at least
 * `floor`. */
static void factorize(const matrix *A, float *inverted, float floor) {
    const size_t n = A->width;
    for (size_t i = 0; i < n; i += 4) {
        const size_t first = i / LANES * LANES;
        for (size_t j = first; j < n; j += LANES) add_gram(A, A, i, i, j, -1);
        for (size_t row = i; row < i + 4; row++) {
            for (size_t before = i; before < row; before++) {
                const value by = conjugate(one(A, before * n + row));
                for (size_t j = first; j < n; j += LANES)
                    put(A, row * n + j, subtract_product(at(A, row * n + j), by, at(A, before * n + j)));
            }
            const float pivot = A->re[row * n + row];
            inverted[row] = 1 / sqrtf(pivot > floor ? pivot : floor);
            for (size_t j = first; j < n; j += LANES)
                put(A, row * n + j, scaled(at(A, row * n + j), filled(inverted[row])));
            memset(A->re + row * n + first, 0, (row + 1 - first) * sizeof(float));
            memset(A->im + row * n + first, 0, (row + 1 - first) * sizeof(float));
        }
    }
}

/* x = (R^H R)^-1 x with R from `factorize`. */
static void solve(const matrix *x, const matrix *R, const float *inverted) {
    const size_t n = R->width;
    for (size_t row = 0; row < n; row++) {
        const float re = x->re[row] * inverted[row], im = x->im[row] * inverted[row];
        const value by = {.re = filled(re), .im = filled(im)};
        for (size_t j = row / LANES * LANES; j < n; j += LANES) {
            const value from = at(R, row * n + j), old = at(x, j);
            put(x, j, (value){.re = old.re - from.re * by.re - from.im * by.im,
                              .im = old.im - from.re * by.im + from.im * by.re});
        }
        x->re[row] = re, x->im[row] = im;
    }
    for (size_t row = n; row-- > 0;) {
        value known = ZERO;
        for (size_t j = row / LANES * LANES; j < n; j += LANES) known = add_product(known, at(R, row * n + j), at(x, j));
        x->re[row] = (x->re[row] - sum(known.re)) * inverted[row];
        x->im[row] = (x->im[row] - sum(known.im)) * inverted[row];
    }
}

/* to (rows, count) = a (rows, inner) from (inner, count), or conj(a) from (sign -1). to_each, step, each: distances
 * between the rows of `to`, `a` and `from`; next: between the columns of a. Whole registers are read and written. */
static void combine(const matrix *to, size_t to_each, const matrix *a, size_t step, size_t next, float sign,
                    const matrix *from, size_t each, size_t rows, size_t inner, size_t count) {
    for (size_t i = 0; i < rows; i++)
        for (size_t j = 0; j < count; j += LANES) {
            value found = ZERO;
            for (size_t e = 0; e < inner; e++) {
                const size_t by = i * step + e * next;
                found = add_product(found, (value){.re = filled(a->re[by]), .im = filled(sign * a->im[by])},
                                    at(from, e * each + j));
            }
            put(to, i * to_each + j, found);
        }
}

#endif
