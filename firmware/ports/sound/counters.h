// SPDX-License-Identifier: MIT
//
// What a running software amplifier counts. The order and sizes are those of `Counters` in
// sim/soft_amp/engine.py.

#ifndef COUNTERS_H
#define COUNTERS_H

#include <stdint.h>

struct counters {
    uint64_t blocks;   // rendered
    uint64_t frames;   // samples of each channel
    uint64_t gaps;     // holes in the sample clock: sound that was lost
    uint64_t xruns;    // reported by the driver or server, mostly without loss
    uint64_t clipped;  // samples beyond the hard limit
    uint64_t requests; // pieces received
    uint32_t is_realtime;  // 1: the sound thread has real-time priority
    uint32_t block;        // frames of the last block
};

#define COUNT(field, by) __atomic_fetch_add(&(field), (by), __ATOMIC_RELAXED)
#define SET(field, value) __atomic_store_n(&(field), (value), __ATOMIC_RELEASE)
#define GET(field) __atomic_load_n(&(field), __ATOMIC_ACQUIRE)

#endif
