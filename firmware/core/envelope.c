// SPDX-License-Identifier: MIT

#include "envelope.h"
#include "sine.h"

struct complex amplitude_of(uint16_t level, int16_t phase)
{
    uint32_t turn = (uint32_t)(phase < 0 ? phase + PHASE_TURN : phase);
    uint32_t angle = (uint32_t)(((uint64_t)turn << 32) / PHASE_TURN);
    int32_t size = (int32_t)(((int64_t)level * ONE) / FULL_STROKE);
    struct complex amplitude = {times(size, cosine(angle)), times(size, sine(angle))};
    return amplitude;
}

int32_t magnitude(struct complex a)
{
    return (int32_t)square_root((uint64_t)((int64_t)a.re * a.re) +
                                (uint64_t)((int64_t)a.im * a.im));
}

uint32_t stride_of(uint32_t tenths)
{
    // Rounded up, so that the end comes with the last sample and not one later.
    uint64_t tenth_samples = (uint64_t)tenths * SAMPLES_PER_MS;
    return (uint32_t)(((UINT64_C(10) << 32) + tenth_samples - 1) / tenth_samples);
}

static struct complex target(const struct walk *walk, uint8_t number)
{
    if (number == walk->path.knots)
        return walk->final;
    return amplitude_of(walk->path.knot[number].level, walk->path.knot[number].phase);
}

void walk_begin(struct walk *walk, const struct envelope *path, struct complex from,
                struct complex final)
{
    walk->path = *path;
    walk->final = final;
    walk->from = from;
    walk->to = target(walk, 0);
    walk->next = 1;
    walk->along = 0;
    walk->stride = stride_of(path->step);
    walk->is_walking = true;
}

static int32_t between(int32_t from, int32_t to, uint32_t along)
{
    return (int32_t)(from + ((((int64_t)to - from) * (int64_t)(along >> 1)) >> 31));
}

struct complex walk_now(const struct walk *walk)
{
    struct complex now = {between(walk->from.re, walk->to.re, walk->along),
                          between(walk->from.im, walk->to.im, walk->along)};
    return now;
}

void walk_step(struct walk *walk)
{
    walk->along += walk->stride;
    if (walk->along >= walk->stride)
        return;
    if (walk->next > walk->path.knots) { // the end of the last line
        walk->is_walking = false;
        return;
    }
    walk->from = walk->to;
    walk->to = target(walk, walk->next);
    walk->next++;
}

uint32_t walk_samples_left(const struct walk *walk)
{
    uint64_t lines = (uint64_t)(walk->path.knots + 1 - walk->next);
    uint64_t left = (lines << 32) + ((UINT64_C(1) << 32) - walk->along);
    return (uint32_t)((left + walk->stride - 1) / walk->stride);
}
