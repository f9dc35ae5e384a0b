/* Knots of an onset and of an ending: least squares over hats at the fingers, within full stroke.
 *
 * The reference in numpy, model/transients/knots.py, explains the forms. Here, unknowns are ordered by
 * combination, then by knot: lanes are knots, and the hat of the previous knot is shifted by one value.
 */
#include "combinations.h"

typedef struct {
    int samples, steps, knots, ending_knots, iterations;
    float ridge, penalty, relaxation; /* ridge and penalty: relative to the mean of a form's diagonal */
    const float *rise;                /* (steps, samples) */
} shaping;

typedef struct {
    int eras, targets, rows, combinations;
    float gain_variance, weight;       /* weight of the targets, or of the quiet fingers of an ending; 0 without such
                                        * fingers */
    const float *hats;                 /* (samples, rows, steps, eras), complex */
    const double *steady, *amplitudes; /* (rows, eras), (eras), complex */
    int total;                         /* endings: number of all ERAs */
    const int *active;                 /* endings: (eras) numbers of the ERAs that play */
    const float *residual;             /* endings: form of the plate (ending knots, total) squared, complex */
} shaped_tone;

/* Return the expected power of all ERAs together, summed over `rows` rows, with gain errors. */
static double expected_power(const shaped_tone *of, size_t first, size_t rows) {
    double found = 0;
    for (size_t row = first; row < first + rows; row++) {
        double re = 0, im = 0;
        for (int e = 0; e < of->eras; e++) {
            const double *a = of->amplitudes + 2 * e, *b = of->steady + 2 * (row * of->eras + e);
            const double own_re = a[0] * b[0] - a[1] * b[1], own_im = a[0] * b[1] + a[1] * b[0];
            re += own_re, im += own_im, found += of->gain_variance * (own_re * own_re + own_im * own_im);
        }
        found += re * re + im * im;
    }
    return found;
}

/* Return the hats of the last knots for rows from `first` on, (samples, rows, eras, span): knots, padded with zeros. */
static matrix hats_of(const shaped_tone *of, const shaping *by, size_t first, size_t knots, size_t span, arena *memory) {
    const size_t n = of->eras, rows = of->rows - first;
    const matrix found = zeros(by->samples * rows, apart(n * span), memory);
    for (size_t row = 0; row < by->samples * rows; row++) {
        const float *from = of->hats + 2 * n * by->steps * (row / rows * of->rows + first + row % rows);
        float *re = found.re + row * found.width, *im = found.im + row * found.width;
        from += 2 * n * (by->steps - knots);
        for (size_t k = 0; k < knots; k++)
            for (size_t e = 0; e < n; e++, from += 2) re[e * span + k] = from[0], im[e * span + k] = from[1];
    }
    return found;
}

/* Return the form (count span) squared of hats, summed over all steps. Only the upper blocks of pairs of combinations
 * are computed. */
static matrix summed(const matrix *hats, size_t rows, size_t count, size_t knots, size_t span, arena *memory) {
    const size_t width = count * span;
    const matrix form = zeros(width, apart(width), memory);
    for (size_t i = 0; i < width; i += 4)
        for (size_t j = i / span * span; j < width && i % span < knots; j += LANES) add_gram(&form, hats, rows, i, j, 1);
    for (size_t a = 0; a < count; a++)
        for (size_t k = knots - 1; k-- > 0;)
            for (size_t b = a; b < count; b++) { /* add the form of the previous step */
                const size_t to = (a * span + k) * form.width + b * span, from = to + form.width + 1;
                for (size_t l = 0; l < span; l += LANES) {
                    const value x = at(&form, to + l), y = at(&form, from + l);
                    put(&form, to + l, (value){.re = x.re + y.re, .im = x.im + y.im});
                }
                for (size_t l = knots; l < span; l++) form.re[to + l] = form.im[to + l] = 0;
            }
    return form;
}

/* Add the effect of errors of the gains to a form over ERAs: more of the parts of a single ERA. */
static void add_errors(const matrix *form, size_t count, size_t span, float gain_variance) {
    for (size_t row = 0; row < count * span; row++)
        for (size_t l = 0; l < span; l += LANES) {
            const size_t own = row * form->width + row / span * span + l;
            put(form, own, scaled(at(form, own), filled(1 + gain_variance)));
        }
}

/* The same for a form over combinations (count, width) of n ERAs: in a combination the parts of all ERAs may cancel,
 * their errors do not. hats (rows, n span): of the ERAs. */
static void add_combined_errors(const matrix *form, const matrix *hats, size_t rows, const matrix *combinations, size_t n,
                                size_t count, size_t knots, size_t span, float gain_variance, arena *memory) {
    const size_t width = combinations->width;
    for (size_t e = 0; e < n; e++) {
        const arena mark = *memory;
        const matrix own_hats = {.re = hats->re + e * span, .im = hats->im + e * span, .width = hats->width};
        const matrix own = summed(&own_hats, rows, 1, knots, span, memory);
        for (size_t a = 0; a < count; a++)
            for (size_t b = a; b < count; b++) {
                const float re_a = combinations->re[a * width + e], im_a = -combinations->im[a * width + e];
                const float re_b = combinations->re[b * width + e], im_b = combinations->im[b * width + e];
                const value factor = {.re = filled(gain_variance * (re_a * re_b - im_a * im_b)),
                                      .im = filled(gain_variance * (re_a * im_b + im_a * re_b))};
                for (size_t k = 0; k < knots; k++)
                    for (size_t l = 0; l < span; l += LANES) {
                        const size_t to = (a * span + k) * form->width + b * span + l;
                        put(form, to, add_product(at(form, to), at(&own, k * own.width + l), factor));
                    }
            }
        release(memory, mark);
    }
}

/* Add sign times the form, in rows of the first knots, times a constant (count) at knots `first` to `end`. */
static void add_held(const matrix *to, const matrix *form, const matrix *held, float sign, size_t count, size_t span,
                     size_t knots, size_t first, size_t end) {
    for (size_t a = 0; a < count; a++)
        for (size_t b = a; b < count; b++) {
            const float re = sign * held->re[b], im = sign * held->im[b];
            const value by = {.re = filled(sign * held->re[a]), .im = filled(sign * held->im[a])};
            for (size_t k = 0; k < knots; k++) {
                const size_t from = (a * span + k) * form->width + b * span;
                float found_re = 0, found_im = 0;
                for (size_t l = first; l < end; l++) found_re += form->re[from + l], found_im += form->im[from + l];
                to->re[a * span + k] += found_re * re - found_im * im;
                to->im[a * span + k] += found_re * im + found_im * re;
            }
            for (size_t l = first; l < end && b > a; l++) /* the lower block of the Hermitian form */
                for (size_t k = 0; k < knots; k += LANES) {
                    const value from = conjugate(at(form, (a * span + l) * form->width + b * span + k));
                    put(to, b * span + k, add_product(at(to, b * span + k), from, by));
                }
        }
}

/* Copy the first knots of each combination to A (n, n), upper triangle, with `more` added to its diagonal, and the
 * right side to x (n). Padded unknowns have no effect. */
static void pack(const matrix *A, const matrix *x, const matrix *form, const matrix *right, size_t count, size_t knots,
                 size_t span, float more) {
    for (size_t a = 0; a < count; a++) {
        memcpy(x->re + a * knots, right->re + a * span, knots * sizeof(float));
        memcpy(x->im + a * knots, right->im + a * span, knots * sizeof(float));
    }
    for (size_t row = 0; row < A->width; row++) {
        const size_t a = row / knots, k = row % knots;
        for (size_t b = a; b < count; b++) {
            const size_t from = (a * span + k) * form->width + b * span, to = row * A->width + b * knots;
            memcpy(A->re + to, form->re + from, knots * sizeof(float));
            memcpy(A->im + to, form->im + from, knots * sizeof(float));
        }
        A->re[row * A->width + row] += more;
    }
}

/* Limit magnitudes to 1. */
INLINE value within(value knots) { return scaled(knots, inverse(larger(root(power(knots)), filled(1)))); }

/* Minimise x^H form x - 2 Re right^H x such that no ERA exceeds its stroke, by the alternating direction method of
 * multipliers; found (knots, eras): the first knots. */
static void bounded_minimum(double *found, const matrix *form, const matrix *right, const matrix *combinations, size_t eras,
                            size_t count, size_t knots, size_t span, const shaping *by, arena *memory) {
    const size_t n = whole(count * knots), each = whole(knots), width = combinations->width;
    const matrix A = zeros(n, n, memory), x = zeros(1, n + each, memory);
    const matrix moved = zeros(eras, each, memory), feasible = zeros(eras, each, memory), dual = zeros(eras, each, memory);
    float size = 0, largest = 0, *inverted = floats(memory, n);
    for (size_t i = 0; i < count * knots; i++) size += form->re[(i / knots * span + i % knots) * (form->width + 1)];
    size = fmaxf(size / (count * knots), 1e-30f);
    pack(&A, &x, form, right, count, knots, span, by->ridge * size);
    factorize(&A, inverted, by->ridge * size);
    solve(&x, &A, inverted);
    combine(&moved, each, combinations, 1, width, 1, &x, knots, eras, count, knots);
    for (size_t i = 0; i < eras * each; i += LANES) put(&feasible, i, within(at(&moved, i)));
    for (size_t e = 0; e < eras; e++)
        for (size_t k = e * each; k < e * each + knots; k++)
            largest = fmaxf(largest, moved.re[k] * moved.re[k] + moved.im[k] * moved.im[k]);
    if (largest > 1) {
        const float penalty = by->penalty * size, old = 1 - by->relaxation;
        pack(&A, &x, form, right, count, knots, span, by->ridge * size + penalty);
        factorize(&A, inverted, by->ridge * size);
        for (int step = 0; step < by->iterations; step++) {
            for (size_t i = 0; i < eras * each; i += LANES) {
                const value a = at(&feasible, i), b = at(&dual, i);
                put(&moved, i, (value){.re = penalty * (a.re - b.re), .im = penalty * (a.im - b.im)});
            }
            combine(&x, knots, combinations, width, 1, -1, &moved, each, count, eras, knots);
            for (size_t a = 0; a < count; a++)
                for (size_t k = 0; k < knots; k++)
                    x.re[a * knots + k] += right->re[a * span + k], x.im[a * knots + k] += right->im[a * span + k];
            solve(&x, &A, inverted);
            combine(&moved, each, combinations, 1, width, 1, &x, knots, eras, count, knots);
            for (size_t i = 0; i < eras * each; i += LANES) {
                const value a = at(&moved, i), b = at(&feasible, i), c = at(&dual, i);
                const value relaxed = {.re = by->relaxation * a.re + old * b.re + c.re,
                                       .im = by->relaxation * a.im + old * b.im + c.im};
                const value kept = within(relaxed);
                put(&feasible, i, kept), put(&dual, i, (value){.re = relaxed.re - kept.re, .im = relaxed.im - kept.im});
            }
        }
    }
    for (size_t i = 0; i < knots * eras; i++) {
        const size_t from = i % eras * each + i / eras;
        const double re = feasible.re[from], im = feasible.im[from], magnitude = sqrt(re * re + im * im);
        const double gain = (1 - 1e-12) / (magnitude > 1 ? magnitude : 1); /* within the stroke in spite of rounding */
        found[2 * i] = isfinite(magnitude) ? gain * re : 0, found[2 * i + 1] = isfinite(magnitude) ? gain * im : 0;
    }
}

static void shape_onset(double *found, const shaped_tone *of, const shaping *by, arena *memory) {
    const size_t t = of->targets, steps = by->steps, span = whole(steps + 1), rows = of->rows, free = by->knots - 1;
    const size_t n = of->eras, count = of->combinations < of->eras ? of->combinations : of->eras, width = whole(n);
    const float weight = of->weight * sqrt(expected_power(of, t, rows - t) / expected_power(of, 0, t));
    matrix hats = hats_of(of, by, 0, steps, span, memory), combinations = zeros(count, width, memory);
    for (size_t row = 0; row < by->samples * rows; row++)
        for (size_t j = 0; j < n * span && row % rows < t; j += LANES)
            put(&hats, row * hats.width + j, scaled(at(&hats, row * hats.width + j), filled(weight)));
    const matrix all = hats;
    if (count < n) {
        combinations = strongest(of->amplitudes, n, count, &all, by->samples * rows, span, memory);
        hats = zeros(by->samples * rows, apart(count * span), memory);
        for (size_t row = 0; row < by->samples * rows; row++) {
            const matrix from = {.re = all.re + row * all.width, .im = all.im + row * all.width, .width = span};
            const matrix to = {.re = hats.re + row * hats.width, .im = hats.im + row * hats.width, .width = span};
            combine(&to, span, &combinations, width, 1, 1, &from, span, count, n, span);
        }
    } else
        for (size_t e = 0; e < n; e++) combinations.re[e * width + e] = 1;
    const matrix form = summed(&hats, by->samples * rows, count, steps, span, memory);
    if (count < n)
        add_combined_errors(&form, &all, by->samples * rows, &combinations, n, count, steps, span, of->gain_variance, memory);
    else
        add_errors(&form, n, span, of->gain_variance);
    const matrix right = zeros(count, span, memory), settled = zeros(1, count, memory), line = zeros(1, 3 * span, memory);
    for (size_t sample = 0; sample < (size_t)by->samples; sample++)
        for (size_t a = 0; a < count; a++) {
            memset(line.re, 0, span * sizeof(float)), memset(line.im, 0, span * sizeof(float));
            for (size_t target = 0; target < t; target++) {
                value wanted = ZERO;
                for (size_t e = 0; e < n; e++) {
                    const double *x = of->amplitudes + 2 * e, *y = of->steady + 2 * (target * n + e);
                    wanted.re += (float)(weight * (x[0] * y[0] - x[1] * y[1]));
                    wanted.im += (float)(weight * (x[0] * y[1] + x[1] * y[0]));
                }
                for (size_t k = 0; k < span; k += LANES) {
                    const value from = conjugate(at(&hats, (sample * rows + target) * hats.width + a * span + k));
                    put(&line, k, add_product(at(&line, k), from, wanted));
                }
            }
            for (size_t step = 0; step < steps; step++) /* a hat of knot k equals the last step of a later knot's hat */
                for (size_t k = 0; k < free; k += LANES) {
                    const value from = at(&line, k + steps - 1 - step), old = at(&right, a * span + k);
                    const float rise = by->rise[step * by->samples + sample];
                    put(&right, a * span + k, (value){.re = old.re + rise * from.re, .im = old.im + rise * from.im});
                }
        }
    for (size_t a = 0; a < count; a++)
        for (size_t e = 0; e < n; e++) {
            const float re = combinations.re[a * width + e], im = combinations.im[a * width + e];
            settled.re[a] += of->amplitudes[2 * e] * re + of->amplitudes[2 * e + 1] * im;
            settled.im[a] += of->amplitudes[2 * e + 1] * re - of->amplitudes[2 * e] * im;
        }
    add_held(&right, &form, &settled, -1, count, span, free, free, steps);
    bounded_minimum(found, &form, &right, &combinations, n, count, free, span, by, memory);
}

static void shape_ending(double *found, const shaped_tone *of, const shaping *by, arena *memory) {
    const size_t n = of->eras, knots = by->ending_knots, free = knots - 1, span = whole(knots + 1), first = of->targets;
    const size_t rows = of->weight > 0 ? of->rows - first : 0, width = n * span, total = of->total;
    const float scale = of->weight / (by->samples * knots);
    matrix form = zeros(width, apart(width), memory);
    const matrix right = zeros(n, span, memory), start = zeros(1, n, memory), identity = zeros(n, whole(n), memory);
    for (size_t e = 0; e < n; e++) {
        start.re[e] = of->amplitudes[2 * e], start.im[e] = of->amplitudes[2 * e + 1];
        identity.re[e * whole(n) + e] = 1;
    }
    if (rows) {
        const matrix hats = hats_of(of, by, first, knots, span, memory);
        form = summed(&hats, by->samples * rows, n, knots, span, memory);
        add_errors(&form, n, span, of->gain_variance);
        add_held(&right, &form, &start, 1, n, span, free, 0, knots);
        for (size_t row = 0; row < rows; row++) {
            const double *steady = of->steady + 2 * n * (first + row);
            float re = 0, im = 0;
            for (size_t e = 0; e < n; e++) {
                re += start.re[e] * (float)steady[2 * e] - start.im[e] * (float)steady[2 * e + 1];
                im += start.re[e] * (float)steady[2 * e + 1] + start.im[e] * (float)steady[2 * e];
            }
            for (size_t e = 0; e < n; e++) {
                const float own_re = start.re[e] * (float)steady[2 * e] - start.im[e] * (float)steady[2 * e + 1];
                const float own_im = start.re[e] * (float)steady[2 * e + 1] + start.im[e] * (float)steady[2 * e];
                const float x = re + of->gain_variance * own_re, y = im + of->gain_variance * own_im;
                float along_re = 0, along_im = 0;
                for (size_t k = knots; k-- > 0;) { /* this hat and all later ones */
                    for (size_t sample = 0; sample < (size_t)by->samples; sample++) {
                        const size_t hat = (sample * rows + row) * hats.width + e * span + k;
                        along_re += hats.re[hat] * x + hats.im[hat] * y, along_im += hats.re[hat] * y - hats.im[hat] * x;
                    }
                    if (k < free) right.re[e * span + k] -= along_re, right.im[e * span + k] -= along_im;
                }
            }
        }
        for (size_t i = 0; i < width * form.width; i += LANES) put(&form, i, scaled(at(&form, i), filled(scale)));
        for (size_t i = 0; i < width; i += LANES) put(&right, i, scaled(at(&right, i), filled(scale)));
    }
    for (size_t a = 0; a < n; a++)
        for (size_t k = 0; k < free; k++) {
            const float *from = of->residual + 2 * ((k + 1) * total + of->active[a]) * knots * total;
            for (size_t b = 0; b < n; b++) {
                const float *held = from + 2 * of->active[b];
                const size_t to = a * span + k;
                right.re[to] -= held[0] * start.re[b] - held[1] * start.im[b];
                right.im[to] -= held[0] * start.im[b] + held[1] * start.re[b];
                for (size_t l = 0; l < free && b >= a; l++) {
                    form.re[to * form.width + b * span + l] += held[2 * (l + 1) * total];
                    form.im[to * form.width + b * span + l] += held[2 * (l + 1) * total + 1];
                }
            }
        }
    bounded_minimum(found, &form, &right, &identity, n, n, free, span, by, memory);
}

static int guarded(void (*shape)(double *, const shaped_tone *, const shaping *, arena *), double *found,
                   const shaped_tone *of, const shaping *by, arena *memory) {
    jmp_buf failed;
    memory->failed = &failed;
    if (setjmp(failed)) return NO_MEMORY;
    shape(found, of, by, memory);
    return 0;
}

/* Compute the knots of an onset or of an ending except the last, (knots - 1, eras) complex; return 0 or NO_MEMORY. */
int shaped_knots(double *found, const shaped_tone *of, const shaping *by, int is_ending) {
    arena memory = {.last = NULL};
    const int status = guarded(is_ending ? shape_ending : shape_onset, found, of, by, &memory);
    release(&memory, (arena){.last = NULL});
    return status;
}
