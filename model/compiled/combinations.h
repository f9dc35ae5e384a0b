/* Combinations of ERAs that move certain fingers most. */
#ifndef COMBINATIONS_H
#define COMBINATIONS_H

#include "rows.h"

/* Return orthonormal combinations (combinations, eras): first the amplitudes, then the eigenvectors of the largest
 * eigenvalues of the form of all rows and knots of `felt`. Eigenvectors are computed by one-sided Jacobi rotations. */
static matrix strongest(const double *amplitudes, size_t n, size_t count, const matrix *felt, size_t rows, size_t span, arena *memory) {
    const size_t width = whole(n);
    const matrix made = zeros(count, width, memory), form = zeros(n, width, memory), own = zeros(n, width, memory);
    float trace = 0, *size = floats(memory, n);
    int *order = integers(memory, n);
    for (size_t e = 0; e < n; e++)
        for (size_t f = e; f < n; f++) {
            value found = ZERO;
            for (size_t row = 0; row < rows; row++)
                for (size_t k = 0; k < span; k += LANES)
                    found = add_conjugate_product(found, at(felt, row * felt->width + e * span + k),
                                                  at(felt, row * felt->width + f * span + k));
            const float re = sum(found.re), im = sum(found.im); /* entry (e, f) of the form */
            form.re[f * width + e] = form.re[e * width + f] = re;
            form.im[f * width + e] = im, form.im[e * width + f] = -im;
            trace += e == f ? re : 0;
        }
    for (size_t e = 0; e < n; e++) own.re[e * width + e] = 1;
    for (size_t i = 0; i < n * width; i++) form.re[i] /= fmaxf(trace, 1e-30f), form.im[i] /= fmaxf(trace, 1e-30f);
    for (int sweep = 0, turned = 1; turned && sweep < 15; sweep++) {
        turned = 0;
        for (size_t p = 0; p < n; p++)
            for (size_t q = p + 1; q < n; q++) {
                value both = ZERO;
                lanes of_p = {0}, of_q = {0};
                for (size_t j = 0; j < width; j += LANES) {
                    const value a = at(&form, p * width + j), b = at(&form, q * width + j);
                    both = add_conjugate_product(both, a, b), of_p += power(a), of_q += power(b);
                }
                const float re = sum(both.re), im = sum(both.im), along = sqrtf(re * re + im * im);
                const float alpha = sum(of_p), beta = sum(of_q);
                if (!(along > 1e-6f * sqrtf(alpha * beta) + 1e-18f)) continue;
                turned = 1;
                const float zeta = (beta - alpha) / (2 * along);
                const float tangent = copysignf(1, zeta) / (fabsf(zeta) + sqrtf(1 + zeta * zeta));
                const float cosine = 1 / sqrtf(1 + tangent * tangent), sine = cosine * tangent;
                const value back = {.re = filled(re / along), .im = filled(-im / along)};
                for (int which = 0; which < 2; which++)
                    for (size_t j = 0; j < width; j += LANES) {
                        const matrix *columns = which ? &own : &form;
                        const value a = at(columns, p * width + j), b = times(back, at(columns, q * width + j));
                        put(columns, p * width + j, (value){.re = cosine * a.re - sine * b.re,
                                                            .im = cosine * a.im - sine * b.im});
                        put(columns, q * width + j, (value){.re = sine * a.re + cosine * b.re,
                                                            .im = sine * a.im + cosine * b.im});
                    }
            }
    }
    for (size_t e = 0; e < n; e++) {
        size_t place = e;
        lanes found = {0};
        for (size_t j = 0; j < width; j += LANES) found += power(at(&form, e * width + j));
        size[e] = sum(found);
        for (; place && size[order[place - 1]] > size[e]; place--) order[place] = order[place - 1];
        order[place] = e;
    }
    for (size_t i = 0; i < count; i++) {
        for (size_t e = 0; e < n && !i; e++) made.re[e] = amplitudes[2 * e], made.im[e] = amplitudes[2 * e + 1];
        for (size_t j = 0; j < width && i; j += LANES) put(&made, i * width + j, at(&own, order[n - count + i] * width + j));
        for (int twice = 0; twice < 2; twice++) {
            lanes length = {0};
            for (size_t before = 0; before < i; before++) {
                value along = ZERO;
                for (size_t j = 0; j < width; j += LANES)
                    along = add_conjugate_product(along, at(&made, before * width + j), at(&made, i * width + j));
                const value by = {.re = filled(sum(along.re)), .im = filled(sum(along.im))};
                for (size_t j = 0; j < width; j += LANES)
                    put(&made, i * width + j, subtract_product(at(&made, i * width + j), at(&made, before * width + j), by));
            }
            for (size_t j = 0; j < width; j += LANES) length += power(at(&made, i * width + j));
            const float norm = sqrtf(sum(length));
            for (size_t j = 0; j < width; j += LANES)
                put(&made, i * width + j, scaled(at(&made, i * width + j), filled(norm > 0 ? 1 / norm : 0)));
        }
    }
    return made;
}

#endif
