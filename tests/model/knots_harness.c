/* Random onsets and endings, among them huge, silent and undefined ones, each piece of memory by itself: prints the
 * largest magnitude of a knot; status 2 for one beyond full stroke or undefined. */
#define ARENA_H
#include "lanes.h"
#include <setjmp.h>
#include <stdio.h>
#include <stdlib.h>

enum { NO_MEMORY = -1 };

typedef struct chunk {
    struct chunk *before;
    void *own;
} chunk;

typedef struct {
    chunk *last;
    char *at;
    jmp_buf *failed;
} arena;

static int left = -1; /* pieces until there is no memory */

static void *take(arena *from, size_t bytes) {
    chunk *piece = malloc(sizeof *piece);
    if (!left-- || posix_memalign(&piece->own, 64, bytes)) free(piece), longjmp(*from->failed, 1);
    piece->before = from->last, from->last = piece;
    return piece->own;
}

static inline float *floats(arena *from, size_t count) { return take(from, count * sizeof(float)); }

static inline int *integers(arena *from, size_t count) { return take(from, count * sizeof(int)); }

static void release(arena *of, arena mark) {
    while (of->last != mark.last) {
        chunk *piece = of->last;
        of->last = piece->before;
        free(piece->own), free(piece);
    }
}

#include "knots.c"

static double drawn(void) { return 2.0 * rand() / RAND_MAX - 1; }

int main(void) {
    float rise[150];
    for (int i = 0; i < 150; i++) rise[i] = i < 40 ? i / 40.0f : 1;
    const shaping by = {.samples = 5, .steps = 30, .knots = 21, .ending_knots = 8, .iterations = 30, .ridge = 1e-6f,
                        .penalty = 0.03f, .relaxation = 1.6f, .rise = rise};
    const double sizes[] = {0.3, 0.01, 1, 1e4, 0, NAN, INFINITY};
    double largest = 0;
    for (int number = 0; number < 28; number++) {
        const int eras = 1 + rand() % 17, targets = 1 + rand() % 2, rows = targets + 5 * (rand() % 4), total = eras + rand() % 3;
        const size_t hats = 5u * rows * 30 * eras * 2, form = 8u * total * 8 * total * 2;
        float *hat = malloc(hats * sizeof(float)), *residual = calloc(form, sizeof(float));
        double *steady = malloc(2 * rows * eras * sizeof(double)), *amplitudes = malloc(2 * eras * sizeof(double));
        double *knots = malloc(2 * 20 * eras * sizeof(double));
        int *active = malloc(eras * sizeof(int));
        for (size_t i = 0; i < hats; i++) hat[i] = sizes[number % 7] * drawn();
        for (int i = 0; i < 8 * total; i++) residual[2 * (i * 8 * total + i)] = 1;
        for (int i = 0; i < 2 * rows * eras; i++) steady[i] = drawn();
        for (int i = 0; i < 2 * eras; i++) amplitudes[i] = drawn() / 2;
        for (int i = 0; i < eras; i++) active[i] = i + total - eras;
        const shaped_tone of = {.eras = eras, .targets = targets, .rows = rows, .combinations = 8,
                                .gain_variance = 0.01f, .weight = rows > targets, .hats = hat, .steady = steady,
                                .amplitudes = amplitudes, .total = total, .active = active, .residual = residual};
        left = number == 9 ? 3 : -1;
        for (int is_ending = 0; is_ending < 2; is_ending++) {
            const int count = is_ending ? 7 : 20, status = shaped_knots(knots, &of, &by, is_ending);
            if ((status == NO_MEMORY) != (number == 9 && !is_ending)) return 1;
            for (int i = 0; i < count * eras && !status; i++) {
                const double size = hypot(knots[2 * i], knots[2 * i + 1]);
                if (!(size <= 1)) return 2;
                largest = size > largest ? size : largest;
            }
        }
        free(hat), free(residual), free(steady), free(amplitudes), free(knots), free(active);
    }
    printf("%.3f\n", largest);
    return 0;
}
