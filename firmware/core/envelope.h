// SPDX-License-Identifier: MIT
//
// Envelopes: what a host has loaded, and the walk of one amplitude along one of them.
//
// A complex amplitude is level x exp(i phase). An envelope moves it along straight lines: from the
// present amplitude to the first knot, from knot to knot, and from the last knot to a final
// amplitude, each in one step. So nothing jumps, and n knots take n + 1 steps.

#ifndef ENVELOPE_H
#define ENVELOPE_H

#include "config.h"

struct complex {
    int32_t re, im; // in units of 2^-30 of full stroke
};

struct knot {
    uint16_t level;
    int16_t phase;
};

struct envelope {
    uint16_t step;  // 0.1 ms
    uint8_t knots;  // 0: an empty slot
    struct knot knot[ENVELOPE_KNOTS];
};

struct walk {
    struct envelope path;
    struct complex from, to, final;
    uint8_t next;            // knot after the one walked to; path.knots: the final amplitude
    uint32_t along, stride;  // position on the present line, a whole turn being its end
    bool is_walking;
};

struct complex amplitude_of(uint16_t level, int16_t phase);

// Magnitude of an amplitude in units of 2^-30 of full stroke.
int32_t magnitude(struct complex amplitude);

// Progress per sample, a whole turn being the end, of what takes this many tenths of a millisecond.
uint32_t stride_of(uint32_t tenths);

void walk_begin(struct walk *walk, const struct envelope *path, struct complex from,
                struct complex final);

// Amplitude at this sample.
struct complex walk_now(const struct walk *walk);

// Move on by one sample. After the last one the walk is over, and `final` the amplitude.
void walk_step(struct walk *walk);

// Samples until the walk has ended.
uint32_t walk_samples_left(const struct walk *walk);

#endif
