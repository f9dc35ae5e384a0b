// SPDX-License-Identifier: MIT
//
// Samples from memory to the outputs of a sound device and from its inputs to memory, in its
// callback: the measuring half of this library, without amplifiers.

#ifndef TRANSFER_H
#define TRANSFER_H

#include <stdint.h>

#include "sound.h"

#define TRANSFER_PORTS_MAX 64

struct transfer_ports {
    void *client;
    void *outputs[TRANSFER_PORTS_MAX];
    void *inputs[TRANSFER_PORTS_MAX];
    void *(*buffer)(void *port, uint32_t frames);
    uint32_t (*frame_time)(const void *client);
};

// Frames are interleaved. Before and after, outputs are silent. position: frames done, written by
// the callback; the memory is the device's from is_running = 1 until position is frames.
struct transfer {
    const float *play;
    float *record;
    uint64_t frames;
    uint64_t position;
    uint32_t outputs, inputs;
    uint32_t is_running;
    uint32_t gaps; // holes in the sample clock meanwhile, or blocks that the driver reports lost
    uint32_t is_lost;
    uint32_t has_next, next_frame;      // of JACK's clock
    const struct transfer_ports *ports; // of JACK
    uint64_t *arrivals;                 // us of CLOCK_MONOTONIC, of each block that was moved; or null
    uint64_t blocks;                    // that were moved
};

// The callbacks are given a struct transfer.

// JACK.
int transfer_jack_process(uint32_t frames, void *given);
void transfer_jack_shutdown(void *given);

// PortAudio's callback, for interleaved floats.
int transfer_portaudio(const void *input, void *output, unsigned long frames,
                       const struct portaudio_time *time, unsigned long flags, void *given);

#endif
