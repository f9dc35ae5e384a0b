// SPDX-License-Identifier: MIT

#include "ring.h"

struct record *ring_free(struct ring *ring)
{
    uint32_t taken = __atomic_load_n(&ring->taken, __ATOMIC_ACQUIRE);
    return ring->written - taken == RING_SIZE ? NULL : &ring->records[ring->written % RING_SIZE];
}

void ring_push(struct ring *ring)
{
    __atomic_store_n(&ring->written, ring->written + 1, __ATOMIC_RELEASE);
}

const struct record *ring_first(const struct ring *ring)
{
    uint32_t written = __atomic_load_n(&ring->written, __ATOMIC_ACQUIRE);
    return ring->taken == written ? NULL : &ring->records[ring->taken % RING_SIZE];
}

void ring_pop(struct ring *ring)
{
    __atomic_store_n(&ring->taken, ring->taken + 1, __ATOMIC_RELEASE);
}
