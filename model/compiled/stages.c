/* Kernels for single stages of an answer, called by numpy code: fingertips, forms, and felt tones. */
#include "answer.h"

typedef struct {
    float *fields, *fine, *power, *uncertain; /* see `formed`; one entry per frequency */
} found_forms;

typedef struct {
    float *powers, *means, *loudest; /* (m, points, plates) or NULL; (m, k, plates); (m, k, plates) */
} found_tones;

typedef struct {
    const void *on, *by, *of;
    const int *rows;
    int count;
    void *to[4];
} job;

static void run_fingertips(const job *each, arena *memory) {
    const raster *on = each->on;
    const size_t k = each->count, few = on->few, fine = on->fine;
    const tips found = read_tips(on, each->by, k, memory);
    memcpy(each->to[0], found.few, k * few * on->r * sizeof(float));
    memcpy(each->to[1], found.fine, k * fine * on->r * sizeof(float));
    memcpy(each->to[2], found.few_weights, k * few * sizeof(float));
    memcpy(each->to[3], found.fine_weights, k * fine * sizeof(float));
}

static void run_forms(const job *each, arena *memory) {
    const plates *on = each->on;
    const grouped *of = each->by;
    const found_forms *to = each->to[0];
    const size_t n = on->n, at = of->groups * of->p;
    formed found = new_forms(on, of, memory);
    for (int first = 0; first < each->count; first += LANES) {
        int rows[LANES], some = each->count - first < LANES ? each->count - first : LANES;
        for (int l = 0; l < LANES; l++) rows[l] = each->rows[first + (l < some ? l : some - 1)];
        find_forms(&found, on, of, rows, memory);
        store(to->fields + 2 * first * at * n, found.fields, at * n, some);
        if (of->fine) store(to->fine + 2 * (size_t)first * of->fine * n, found.fine, of->fine * n, some);
        store(to->power + 2 * (size_t)first * of->groups * n * n, found.power, of->groups * n * n, some);
        store(to->uncertain + 2 * (size_t)first * of->groups * n * n, found.uncertain, of->groups * n * n, some);
    }
}

static void run_tones(const job *each, arena *memory) {
    const plates *on = each->on;
    const draws *by = each->by;
    const sensors *at = each->of;
    const found_tones *to = each->to[0];
    const size_t points = at->points, k = on->k, plates = 1 + by->count, fine = points / k;
    const float *columns = columns_of(at->rows, points, on, memory);
    const tones drawn = respond(on, by, at, columns, each->count, each->rows, each->to[1], memory);
    lanes *sensed = take(memory, points * sizeof(lanes));
    value *found = values(memory, points), *force = values(memory, on->b + k + 1);
    for (size_t tone = 0; tone < (size_t)each->count; tone++)
        for (size_t group = 0; group < group_count(by); group++) {
            size_t first, count = plates_of(by, group, &first);
            sense(sensed, &drawn, tone, group, found, force);
            for (size_t finger = 0; finger < k; finger++) {
                lanes mean = {0}, highest = {0};
                for (size_t i = finger * fine; i < (finger + 1) * fine; i++) {
                    mean += at->weights[i] * root(sensed[i]), highest = larger(highest, sensed[i]);
                    if (to->powers)
                        memcpy(to->powers + (tone * points + i) * plates + first, sensed + i, count * sizeof(float));
                }
                memcpy(to->means + (tone * k + finger) * plates + first, &mean, count * sizeof(float));
                memcpy(to->loudest + (tone * k + finger) * plates + first, &highest, count * sizeof(float));
            }
        }
}

static int guarded(void (*run)(const job *, arena *), const job *each, arena *memory) {
    jmp_buf failed;
    memory->failed = &failed;
    if (setjmp(failed)) return NO_MEMORY;
    run(each, memory);
    return FOUND;
}

static int done(void (*run)(const job *, arena *), job each) {
    arena memory = {.last = NULL};
    const int status = guarded(run, &each, &memory);
    release(&memory, (arena){.last = NULL});
    return status;
}

/* Compute `tips`, without the centers, for fingertips at places (count, 2) [m]. */
int fingertips_stage(const raster *on, const double *places, int count, void *few, void *fine, void *few_weights,
                     void *fine_weights) {
    return done(run_fingertips, (job){.on = on, .by = places, .count = count,
                                      .to = {few, fine, few_weights, fine_weights}});
}

/* Store T in blocks of consecutive frequencies, for searches over all frequencies. */
int blocks_stage(plates *on) {
    const size_t each = (size_t)on->b * on->r;
    value *to = on->of_blocks;
    for (int first = 0; first < on->rows; first += LANES)
        for (int thickness = 0; thickness < on->kept; thickness++, to += each) {
            int cases[LANES];
            for (int l = 0; l < LANES; l++) cases[l] = row_of_block(on, first, l) * on->t + thickness;
            load(to, on->by_force, each, cases);
        }
    return FOUND;
}

/* Compute fields and forms at rows (count). */
int forms_stage(const plates *on, const grouped *of, const int *rows, int count, found_forms *to) {
    return done(run_forms, (job){.on = on, .by = of, .rows = rows, .count = count, .to = {to}});
}

/* Compute the felt amplitudes of tones at rows (count) with weights (count, n). */
int tones_stage(const plates *on, const draws *by, const sensors *at, const int *rows, int count, float *weights,
                found_tones *to) {
    return done(run_tones, (job){.on = on, .by = by, .of = at, .rows = rows, .count = count, .to = {to, weights}});
}
