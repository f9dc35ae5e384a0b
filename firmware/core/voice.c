// SPDX-License-Identifier: MIT

#include "voice.h"
#include "sine.h"

static int32_t present_gain(const struct voice *voice)
{
    switch (voice->gain) {
    case GAIN_RISING:
        return raised_cosine(voice->along);
    case GAIN_FALLING:
        return times(voice->gain_from, ONE - raised_cosine(voice->along));
    default:
        return ONE;
    }
}

static struct complex present_amplitude(const struct voice *voice)
{
    return voice->walk.is_walking ? walk_now(&voice->walk) : voice->amplitude;
}

void voice_begin(struct voice *voice, uint16_t frequency, struct complex amplitude, uint16_t ramp)
{
    voice->is_sounding = true;
    voice->frequency = frequency;
    voice->angle = 0;
    voice->pace = (uint32_t)((((uint64_t)frequency << 32) + SAMPLE_RATE * FREQUENCY_PER_HZ / 2) /
                             (SAMPLE_RATE * FREQUENCY_PER_HZ));
    voice->amplitude = amplitude;
    voice->walk.is_walking = false;
    voice->gain = ramp > 0 ? GAIN_RISING : GAIN_STEADY;
    voice->along = 0;
    voice->stride = ramp > 0 ? stride_of(ramp * 10u) : 0;
}

void voice_walk(struct voice *voice, const struct envelope *path, struct complex final)
{
    int32_t gain = present_gain(voice);
    struct complex from = present_amplitude(voice);
    from.re = times(from.re, gain);
    from.im = times(from.im, gain);
    voice->gain = GAIN_STEADY;
    voice->amplitude = final;
    walk_begin(&voice->walk, path, from, final);
}

static bool walks_to_silence(const struct voice *voice)
{
    return voice->walk.is_walking && voice->walk.final.re == 0 && voice->walk.final.im == 0;
}

// The least stride that gets a gain from `along` to its end within so many samples.
static uint32_t stride_within(uint32_t samples)
{
    return (uint32_t)(((UINT64_C(1) << 32) + samples - 1) / samples);
}

static uint32_t ramp_samples_left(const struct voice *voice)
{
    return (uint32_t)(((UINT64_C(1) << 32) - voice->along + voice->stride - 1) / voice->stride);
}

void voice_fall(struct voice *voice, uint16_t ramp)
{
    uint32_t samples = (uint32_t)ramp * SAMPLES_PER_MS;
    if (!voice->is_sounding)
        return;
    if (samples == 0) {
        voice->is_sounding = false;
        return;
    }
    if (voice->gain == GAIN_FALLING && ramp_samples_left(voice) <= samples)
        return;
    // An envelope that ends sooner is left for a ramp that ends with it.
    if (walks_to_silence(voice) && walk_samples_left(&voice->walk) < samples)
        samples = walk_samples_left(&voice->walk);
    voice->gain_from = present_gain(voice);
    voice->amplitude = present_amplitude(voice);
    voice->walk.is_walking = false;
    voice->gain = GAIN_FALLING;
    voice->along = 0;
    voice->stride = stride_within(samples);
}

bool voice_lasts(const struct voice *voice)
{
    return voice->is_sounding && voice->gain != GAIN_FALLING && !walks_to_silence(voice);
}

static void move_gain(struct voice *voice)
{
    voice->along += voice->stride;
    if (voice->along >= voice->stride)
        return;
    if (voice->gain == GAIN_FALLING)
        voice->is_sounding = false;
    voice->gain = GAIN_STEADY;
}

int32_t voice_sample(struct voice *voice)
{
    if (!voice->is_sounding)
        return 0;
    struct complex amplitude = present_amplitude(voice);
    int32_t value = times(amplitude.re, sine(voice->angle)) +
                    times(amplitude.im, cosine(voice->angle));
    if (voice->gain != GAIN_STEADY) {
        value = times(value, present_gain(voice));
        move_gain(voice);
    }
    if (voice->walk.is_walking) {
        bool is_last = walks_to_silence(voice);
        walk_step(&voice->walk);
        if (is_last && !voice->walk.is_walking)
            voice->is_sounding = false;
    }
    voice->angle += voice->pace;
    return value;
}

int32_t voice_size(const struct voice *voice)
{
    if (!voice->is_sounding)
        return 0;
    return times(magnitude(present_amplitude(voice)), present_gain(voice));
}
