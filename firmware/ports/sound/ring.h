// SPDX-License-Identifier: MIT
//
// A queue of records from one thread to another, without locks: neither ever waits.

#ifndef RING_H
#define RING_H

#include "counters.h"

#include <stdbool.h>
#include <stddef.h>

#define RECORD_MAX 264
#define RING_SIZE 64 // records

// Bytes of a connection; generation: which of those that have used its place.
struct record {
    uint8_t connection;
    uint32_t generation;
    uint16_t length;
    uint8_t bytes[RECORD_MAX];
};

struct ring {
    struct record records[RING_SIZE];
    uint32_t written, taken; // in all
};

// The record to fill in, or null while the ring is full; then ring_push it.
static inline struct record *ring_free(struct ring *ring)
{
    bool is_full = ring->written - GET(ring->taken) == RING_SIZE;
    return is_full ? NULL : &ring->records[ring->written % RING_SIZE];
}

static inline void ring_push(struct ring *ring)
{
    SET(ring->written, ring->written + 1);
}

// The oldest record, or null; then ring_pop it.
static inline const struct record *ring_first(const struct ring *ring)
{
    return ring->taken == GET(ring->written) ? NULL : &ring->records[ring->taken % RING_SIZE];
}

static inline void ring_pop(struct ring *ring)
{
    SET(ring->taken, ring->taken + 1);
}

#endif
