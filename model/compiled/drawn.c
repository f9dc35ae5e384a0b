/* What fingertips feel on drawn plates: `model.ensemble.drawn` in C. Lanes are drawn plates. */
#include "lanes.h"

typedef struct {
    int points, k, a, tones;                 /* points of all fingers; fingers; attachments; tones */
    int bases, draws, nodes, width;          /* thicknesses of changes; drawn plates, in rows of width */
    const int *sources;                      /* (tones, bases): which of by_force */
    const float *by_force;                   /* (sources, points, a) */
    const float *by_loss;                    /* (tones, bases, points) */
    const float *loss, *damping, *own, *drives; /* (tones, bases, a) forces of each change */
    const float *at_nodes;                   /* (tones, 1 + nodes, points), that as modelled first */
    const int *node;                         /* (draws) */
    const float *draw_loss, *draw_damping;   /* (width) */
    const float *draw_own, *draw_gain;       /* (a, width); (2, a, width) real and imaginary parts */
    const float *draw_error;                 /* (2, k, width) */
    const float *error, *threshold, *weights; /* (tones); (tones); (points) */
    float *powers;                           /* (tones, points, 1 + draws), or none */
    float *means, *loudest;                  /* (tones, k, 1 + draws) */
} drawn;

INLINE lanes some(const float *from) {
    lanes found;
    memcpy(&found, from, sizeof found);
    return found;
}

/* Values of work space. */
size_t drawn_space(const drawn *on) { return on->a + on->points; }

/* Amplitudes over thresholds of one base's drawn plates from one on. */
INLINE void felt(const drawn *on, size_t tone, size_t base, size_t from, size_t count, value *work) {
    const size_t a = on->a, points = on->points, each = points / on->k, width = on->width;
    const size_t at = tone * on->bases + base, plates = 1 + on->draws;
    const float *T = on->by_force + 2 * (size_t)on->sources[at] * points * a;
    const float *lost = on->by_loss + 2 * at * points;
    value *force = work, *found = force + a;
    lanes by_loss = some(on->draw_loss + from), by_damping = some(on->draw_damping + from);
    for (size_t j = 0; j < a; j++) {
        const float *loss = on->loss + 2 * (at * a + j), *damping = on->damping + 2 * (at * a + j);
        const float *own = on->own + 2 * (at * a + j), *drive = on->drives + 2 * (at * a + j);
        lanes by_own = some(on->draw_own + j * width + from);
        lanes re = some(on->draw_gain + j * width + from), im = some(on->draw_gain + (a + j) * width + from);
        force[j].re = loss[0] * by_loss + damping[0] * by_damping + own[0] * by_own + drive[0] * re - drive[1] * im;
        force[j].im = loss[1] * by_loss + damping[1] * by_damping + own[1] * by_own + drive[0] * im + drive[1] * re;
    }
    int rows[LANES];
    for (size_t l = 0; l < LANES; l++)
        rows[l] = tone * (1 + on->nodes) + 1 + on->node[from + (l < count ? l : 0)];
    load(found, on->at_nodes, points, rows);
    for (size_t i = 0; i < points; i++) {
        found[i].re += lost[2 * i] * by_loss;
        found[i].im += lost[2 * i + 1] * by_loss;
    }
    for (size_t i = 0; i < points; i += 4) {
        const float *row[4];
        value sum[4];
        for (size_t s = 0; s < 4; s++) {
            size_t one = i + s < points ? i + s : points - 1;
            row[s] = T + 2 * one * a, sum[s] = found[one];
        }
        value s0 = sum[0], s1 = sum[1], s2 = sum[2], s3 = sum[3]; /* in registers, as no array is */
        for (size_t j = 0; j < a; j++) {
            value by = force[j];
            const float *t0 = row[0] + 2 * j, *t1 = row[1] + 2 * j, *t2 = row[2] + 2 * j, *t3 = row[3] + 2 * j;
            s0.re += t0[0] * by.re - t0[1] * by.im, s0.im += t0[0] * by.im + t0[1] * by.re;
            s1.re += t1[0] * by.re - t1[1] * by.im, s1.im += t1[0] * by.im + t1[1] * by.re;
            s2.re += t2[0] * by.re - t2[1] * by.im, s2.im += t2[0] * by.im + t2[1] * by.re;
            s3.re += t3[0] * by.re - t3[1] * by.im, s3.im += t3[0] * by.im + t3[1] * by.re;
        }
        value done[4] = {s0, s1, s2, s3};
        for (size_t s = 0; s < 4 && i + s < points; s++) found[i + s] = done[s];
    }
    const float above = 1 / (on->threshold[tone] * on->threshold[tone]), error = on->error[tone];
    for (size_t finger = 0; finger < (size_t)on->k; finger++) {
        lanes re = error * some(on->draw_error + finger * width + from), mean = {0}, loudest = {0};
        lanes im = error * some(on->draw_error + (on->k + finger) * width + from);
        for (size_t i = finger * each; i < (finger + 1) * each; i++) {
            lanes sensed = above * power((value){found[i].re + re, found[i].im + im});
            loudest = larger(loudest, sensed);
            mean += on->weights[i] * root(sensed);
            if (!on->powers) continue;
            float *to = on->powers + (tone * points + i) * plates + 1 + from;
            memcpy(to, &sensed, count * sizeof(float));
        }
        size_t to = (tone * on->k + finger) * plates + 1 + from;
        memcpy(on->means + to, &mean, count * sizeof(float));
        memcpy(on->loudest + to, &loudest, count * sizeof(float));
    }
}

/* The plate as modelled. */
INLINE void as_modelled(const drawn *on, size_t tone) {
    const size_t points = on->points, each = points / on->k, plates = 1 + on->draws;
    const float *h = on->at_nodes + 2 * tone * (1 + on->nodes) * points;
    const float above = 1 / (on->threshold[tone] * on->threshold[tone]);
    for (size_t finger = 0; finger < (size_t)on->k; finger++) {
        float mean = 0, loudest = 0;
        for (size_t i = finger * each; i < (finger + 1) * each; i++) {
            float sensed = above * (h[2 * i] * h[2 * i] + h[2 * i + 1] * h[2 * i + 1]);
            loudest = sensed > loudest ? sensed : loudest;
            mean += on->weights[i] * sqrtf(sensed);
            if (on->powers) on->powers[(tone * points + i) * plates] = sensed;
        }
        on->means[(tone * on->k + finger) * plates] = mean;
        on->loudest[(tone * on->k + finger) * plates] = loudest;
    }
}

void drawn_plates(const drawn *on, value *work) {
    const size_t each = on->draws / on->bases;
    for (size_t tone = 0; tone < (size_t)on->tones; tone++) {
        as_modelled(on, tone);
        for (size_t base = 0; base < (size_t)on->bases; base++)
            for (size_t from = 0; from < each; from += LANES) {
                size_t left = each - from;
                felt(on, tone, base, base * each + from, left < LANES ? left : LANES, work);
            }
    }
}
