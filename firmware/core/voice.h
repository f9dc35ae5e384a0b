// SPDX-License-Identifier: MIT
//
// A voice: one oscillator with a complex amplitude and a gain.
//
// The amplitude stands still or walks along an envelope; the gain stands still, rises or falls
// along a raised cosine. A channel has at least two voices, so that one can fade out while another
// fades in. The work for a sample is the same however many requests have arrived.

#ifndef VOICE_H
#define VOICE_H

#include "envelope.h"

enum gain { GAIN_STEADY, GAIN_RISING, GAIN_FALLING };

struct voice {
    bool is_sounding;
    uint16_t frequency;
    uint32_t angle, pace;       // of the oscillator, and its step per sample
    struct complex amplitude;   // unless walking
    struct walk walk;
    enum gain gain;
    int32_t gain_from;          // where a falling gain began
    uint32_t along, stride;     // position on the ramp of the gain
};

// Begin at t = 0 with an amplitude, along a ramp [ms].
void voice_begin(struct voice *voice, uint16_t frequency, struct complex amplitude, uint16_t ramp);

// Move the amplitude along an envelope, from the present amplitude to a final one.
void voice_walk(struct voice *voice, const struct envelope *path, struct complex final);

// Fall silent along a ramp [ms] from the present amplitude; sooner than before, or not at all.
void voice_fall(struct voice *voice, uint16_t ramp);

// Whether it sounds and does not fall silent.
bool voice_lasts(const struct voice *voice);

// Value at this sample in units of 2^-30 of full stroke; then move on by one sample.
int32_t voice_sample(struct voice *voice);

// Present size in units of 2^-30 of full stroke.
int32_t voice_size(const struct voice *voice);

#endif
