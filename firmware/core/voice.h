// SPDX-License-Identifier: MIT
//
// A voice: one oscillator with a complex amplitude, level x exp(i phase), that stands still or is on
// its way.
//
// It goes along straight lines through the knots of an envelope, a step each, or without knots along
// a raised cosine; so nothing jumps. The work for a sample is the same however many requests have
// arrived.

#ifndef VOICE_H
#define VOICE_H

#include "set.h"

struct complex {
    int32_t re, im; // in units of 2^-30 of full level
};

struct voice {
    bool is_playing;
    uint8_t layer;
    bool has_ended;           // it falls silent, and nothing continues it
    uint16_t frequency;
    uint16_t level;           // to which it leads; its phase, 0 without a level
    int16_t phase;
    struct complex from, to;  // ends of the present line
    uint32_t along, stride;   // position on it, a whole turn being its end; stride 0: it stands at `to`
    uint32_t last_stride;     // that of the way it came, while it stands; 0: it jumped
    uint8_t next;             // knot behind this line; path.knots: the final amplitude
    struct envelope path;     // its way; without knots a raised cosine
    bool has_ending;
    struct envelope ending;   // how it falls silent by itself
    uint64_t since;           // sample at which it was sent on its way
    uint32_t still_at;        // sample (low bits) at which its way ends or ended
    uint32_t number;          // of voices, in the order of their beginnings
};

// Begin in a layer, silent.
void voice_begin(struct voice *voice, uint8_t layer, uint16_t frequency, uint32_t number);

// Send it from its present amplitude to the tone of a command: along its onset, or a ramp [ms].
void voice_lead(struct voice *voice, const struct command *command, uint16_t ramp, uint64_t sample);

// Let it fall silent along a ramp [ms], or as it does if that is sooner.
void voice_fade(struct voice *voice, uint16_t ramp, uint64_t sample);

// Let it fall silent along its ending, or along a ramp [ms] without one.
void voice_end(struct voice *voice, uint16_t ramp, uint64_t sample);

// Samples from a sample on until it stands still.
static inline uint32_t voice_samples_left(const struct voice *voice, uint64_t sample)
{
    return voice->stride > 0 ? voice->still_at - (uint32_t)sample : 0;
}

// Whether it plays, or played some samples before a sample.
static inline bool voice_sounded(const struct voice *voice, uint64_t sample, uint32_t before)
{
    uint32_t way = voice->still_at - (uint32_t)voice->since; // samples
    return voice->is_playing || voice->since + way + before > sample;
}

// Whether it is not silent within a time [ms] by itself.
static inline bool voice_outlasts(const struct voice *voice, uint16_t milliseconds, uint64_t sample)
{
    uint32_t samples = (uint32_t)milliseconds * SAMPLES_PER_MS;
    return voice->level > 0 || voice_samples_left(voice, sample) > samples;
}

// Value at this sample, at a time of the clock, in units of 2^-30 of full level; then move on by one.
int32_t voice_sample(struct voice *voice, uint32_t clock);

// Its amplitude some samples before a sample, or at the beginning of its last line if that is later.
struct complex voice_amplitude(const struct voice *voice, uint64_t sample, uint32_t before);

// Turn an amplitude by the angle of the oscillator: those of one frequency add up.
struct complex voice_pointer(const struct voice *voice, uint32_t clock, struct complex amplitude);

#endif
