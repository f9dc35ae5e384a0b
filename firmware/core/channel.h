// SPDX-License-Identifier: MIT
//
// A channel: the pool of its voices, of all layers.

#ifndef CHANNEL_H
#define CHANNEL_H

#include "voice.h"

// Where fades are cut short they need a place for those last milliseconds.
#define VOICES_CUT LAYERS
#define VOICES_KEPT (VOICES + VOICES_CUT)

struct channel {
    struct voice voices[VOICES_KEPT];
    uint32_t begun; // voices, in all
};

// Play the command of a layer from a sample on, or let the layer fall silent without one (null).
void channel_play(struct channel *channel, uint8_t layer, const struct command *command,
                  uint16_t ramp, uint64_t sample);

// Let all layers fall silent along a ramp [ms].
void channel_silence(struct channel *channel, uint16_t ramp, uint64_t sample);

// The voice that a layer plays and that has not ended, or null.
const struct voice *channel_voice(const struct channel *channel, uint8_t layer);

// Layers with such a voice, a bit each.
uint16_t channel_layers(const struct channel *channel);

bool channel_is_silent(const struct channel *channel);

// Level some samples before a sample: the largest amplitude of the sum.
uint16_t channel_level(const struct channel *channel, uint64_t sample, uint32_t clock,
                       uint32_t before);

// Sum of the voices at this sample in units of 2^-30 of full level; then move on by one sample.
int64_t channel_sum(struct channel *channel, uint32_t clock);

#endif
