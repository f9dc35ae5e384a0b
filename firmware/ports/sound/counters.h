// SPDX-License-Identifier: MIT
//
// What a running software amplifier counts, in memory that the process which watches it shares.
// The order and sizes are those of sim/soft_amp/counters.py.

#ifndef COUNTERS_H
#define COUNTERS_H

#include <stdint.h>

struct counters {
    uint64_t blocks;   // rendered; stands still when the sound thread does
    uint64_t frames;   // samples of each channel
    uint64_t gaps;     // holes in the sample clock: sound that was lost
    uint64_t xruns;    // reported by the driver or server, mostly without loss
    uint64_t clipped;  // samples beyond the hard limit
    uint64_t requests; // pieces received
    uint32_t is_streaming; // the sound thread is to render
    uint32_t is_lost;      // the device has gone
    uint32_t is_realtime;  // bit 0: the sound thread, bit 1: that of the lines
    uint32_t state[2], fault[2]; // of each amplifier
    uint32_t block;        // frames, of the last block
};

#define COUNT(field, by) __atomic_fetch_add(&(field), (by), __ATOMIC_RELAXED)
#define SET(field, value) __atomic_store_n(&(field), (value), __ATOMIC_RELEASE)
#define GET(field) __atomic_load_n(&(field), __ATOMIC_ACQUIRE)

#endif
