// SPDX-License-Identifier: MIT
//
// A channel: its voices, and the command that it plays.

#ifndef CHANNEL_H
#define CHANNEL_H

#include "config.h"
#include "voice.h"

struct command {
    uint8_t channel, flags;
    uint16_t frequency, level;
    int16_t phase;
    uint8_t onset, ending; // slots; 0: none
};

struct channel {
    struct voice voices[VOICES];
    uint8_t newest;         // the voice that began last
    bool has_command;       // plays one, as against falling silent
    uint16_t ramp;          // of its set
    struct envelope ending; // of its command; without knots: none
};

// Whether a command can be played now: a voice must be free for it.
bool channel_has_room(const struct channel *channel, const struct command *command, uint16_t ramp);

// Play a command for which there is room; onset and ending: its envelopes, or null.
void channel_play(struct channel *channel, const struct command *command, uint16_t ramp,
                  const struct envelope *onset, const struct envelope *ending);

// Fall silent along the ending of the command, or else along a ramp [ms].
void channel_end(struct channel *channel, uint16_t ramp);

// Fall silent along a ramp [ms], whatever the ending.
void channel_quiet(struct channel *channel, uint16_t ramp);

bool channel_is_sounding(const struct channel *channel);

// Present level: the sum of its voices, at least one step while anything sounds.
uint16_t channel_level(const struct channel *channel);

// Sum of the voices at this sample in units of 2^-30 of full stroke, within the full one; then move on
// by one sample.
int32_t channel_force(struct channel *channel);

// A force as a sample, 32767 being full stroke, or full voltage with SQUARE_LAW.
int16_t sample_of(int32_t force);

#endif
