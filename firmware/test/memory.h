// SPDX-License-Identifier: MIT
//
// A board in memory: what arrives, is sent and is played.

#ifndef MEMORY_H
#define MEMORY_H

#include "board.h"

#define LINES 3
#define RING 8192 // bytes
#define SAMPLES_MAX (1 << 21)

extern struct memory {
    struct {
        uint8_t arrived[RING], sent[RING];
        uint32_t arrived_length, arrived_at, sent_length;
        uint64_t heard_at;
    } lines[LINES];
    uint64_t now, samples_counted; // us, and those made of them
    uint32_t buffered;             // samples that are made ahead
    int16_t samples[SAMPLES_MAX];
    uint32_t samples_length; // of all channels, not fetched yet
    bool is_interlock_open;
    uint32_t sample_time; // us; that making a sample takes
    uint8_t addresses[LINES];
} memory;

#endif
