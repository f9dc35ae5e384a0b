// SPDX-License-Identifier: MIT
//
// Samples from memory to the outputs of a sound device and from its inputs to memory, in its
// callback: the measuring half of this library, without amplifiers.

#ifndef TRANSFER_H
#define TRANSFER_H

#include <stdint.h>

#include "sound.h"

// Frames are interleaved. Outputs are silent before and after a run. The memory belongs to the
// callback from is_running = 1 until position is frames.
struct transfer {
    const float *play;
    float *record;
    uint64_t frames;
    uint64_t position; // frames done, written by the callback
    uint32_t outputs, inputs;
    uint32_t is_running;
    uint32_t gaps; // blocks of a run that the driver reports as lost
};

// PortAudio's callback, for interleaved floats; given: a struct transfer.
int transfer_portaudio(const void *input, void *output, unsigned long frames,
                       const struct portaudio_time *time, unsigned long flags, void *given);

#endif
