// SPDX-License-Identifier: MIT
//
// A time that ends by the sample clock or by real time, whichever is first: a converter that stands
// still, a stalled loop or a halted core prolong nothing.

#ifndef TIMER_H
#define TIMER_H

#include "config.h"

struct timer {
    uint32_t samples; // left; 0: it does not run
    uint64_t until;   // us of real time
};

static inline void timer_start(struct timer *timer, uint32_t milliseconds, uint64_t now)
{
    timer->samples = milliseconds * SAMPLES_PER_MS;
    timer->until = now + (uint64_t)milliseconds * 1000;
}

static inline void timer_stop(struct timer *timer)
{
    timer->samples = 0;
}

// Let a sample's time pass; return whether it ends with it.
static inline bool timer_sample(struct timer *timer)
{
    return timer->samples > 0 && --timer->samples == 0;
}

// Whether it has ended by real time; slack: us by which samples may come late.
static inline bool timer_is_late(const struct timer *timer, uint64_t now, uint32_t slack)
{
    return timer->samples > 0 && now >= timer->until + slack;
}

// The time left in ms, by samples or by real time, whichever is less.
static inline uint16_t timer_left(const struct timer *timer, uint64_t now)
{
    uint64_t left = (uint64_t)timer->samples * 1000 / SAMPLES_PER_MS;
    if (timer->samples > 0 && timer->until < now + left)
        left = timer->until > now ? timer->until - now : 0;
    return (uint16_t)((left + 500) / 1000);
}

#endif
