// SPDX-License-Identifier: MIT

#include "channel.h"
#include "sine.h"

static bool plays_in(const struct voice *voice, uint8_t layer)
{
    return voice->is_playing && voice->layer == layer && !voice->has_ended;
}

// A place for another voice: one that is silent, else that of the fade that ends first. There are
// as many more places than voices as one set can cut short.
static struct voice *place(struct channel *channel, uint64_t sample)
{
    struct voice *first = &channel->voices[0];
    for (unsigned i = 0; i < VOICES_KEPT; i++)
        if (!channel->voices[i].is_playing)
            return &channel->voices[i];
    for (unsigned i = 0; i < VOICES_KEPT; i++) {
        struct voice *voice = &channel->voices[i];
        if (voice->level == 0 && (first->level > 0 || voice_samples_left(voice, sample) <
                                                          voice_samples_left(first, sample)))
            first = voice;
    }
    return first;
}

static bool is_older(const struct voice *voice, const struct voice *than)
{
    return voice->since < than->since ||
           (voice->since == than->since && voice->number < than->number);
}

static bool is_lasting(const struct voice *voice, uint64_t sample)
{
    return voice->is_playing && voice_outlasts(voice, SHORTENED_FADE_MS, sample);
}

// The fade that can be cut short and began first, or null.
static struct voice *oldest_fade(struct channel *channel, uint64_t sample)
{
    struct voice *oldest = NULL;
    for (unsigned i = 0; i < VOICES_KEPT; i++) {
        struct voice *voice = &channel->voices[i];
        if (voice->has_ended && is_lasting(voice, sample) &&
            (oldest == NULL || is_older(voice, oldest)))
            oldest = voice;
    }
    return oldest;
}

// Cut the oldest fades short if more voices last than there are.
static void keep_within(struct channel *channel, uint64_t sample)
{
    unsigned lasting = 0;
    for (unsigned i = 0; i < VOICES_KEPT; i++)
        lasting += is_lasting(&channel->voices[i], sample);
    while (lasting-- > VOICES) {
        struct voice *oldest = oldest_fade(channel, sample);
        if (oldest == NULL)
            return;
        voice_fade(oldest, SHORTENED_FADE_MS, sample);
    }
}

void channel_play(struct channel *channel, uint8_t layer, const struct command *command,
                  uint16_t ramp, uint64_t sample)
{
    bool is_driven = command != NULL && (command->level > 0 || command->has_onset);
    struct voice *continued = NULL;
    for (unsigned i = 0; i < VOICES_KEPT; i++) {
        struct voice *voice = &channel->voices[i];
        if (!plays_in(voice, layer))
            continue;
        if (is_driven && command->keep_phase && voice->frequency == command->frequency)
            continued = voice;
        else if (is_driven || (command != NULL && command->skip_ending))
            voice_fade(voice, ramp, sample);
        else
            voice_end(voice, ramp, sample);
    }
    if (is_driven) {
        if (continued == NULL) {
            continued = place(channel, sample);
            voice_begin(continued, layer, command->frequency, channel->begun++);
        }
        voice_lead(continued, command, ramp, sample);
    }
    keep_within(channel, sample);
}

void channel_silence(struct channel *channel, uint16_t ramp, uint64_t sample)
{
    for (unsigned i = 0; i < VOICES_KEPT; i++)
        if (channel->voices[i].is_playing)
            voice_fade(&channel->voices[i], ramp, sample);
}

const struct voice *channel_voice(const struct channel *channel, uint8_t layer)
{
    for (unsigned i = 0; i < VOICES_KEPT; i++)
        if (plays_in(&channel->voices[i], layer))
            return &channel->voices[i];
    return NULL;
}

uint16_t channel_layers(const struct channel *channel)
{
    uint16_t layers = 0;
    for (unsigned i = 0; i < VOICES_KEPT; i++) {
        const struct voice *voice = &channel->voices[i];
        if (voice->is_playing && !voice->has_ended)
            layers |= (uint16_t)(1 << voice->layer);
    }
    return layers;
}

bool channel_is_silent(const struct channel *channel)
{
    for (unsigned i = 0; i < VOICES_KEPT; i++)
        if (channel->voices[i].is_playing)
            return false;
    return true;
}

// Magnitude of a sum of amplitudes, in units of 2^-30 of full level.
static uint64_t magnitude(int64_t re, int64_t im)
{
    re /= VOICES_KEPT; // so that the squares fit
    im /= VOICES_KEPT;
    return (uint64_t)square_root((uint64_t)(re * re) + (uint64_t)(im * im)) * VOICES_KEPT;
}

uint16_t channel_level(const struct channel *channel, uint32_t clock, uint32_t before)
{
    uint64_t size = 0;
    bool is_counted[VOICES_KEPT] = {false};
    for (unsigned i = 0; i < VOICES_KEPT; i++) {
        int64_t re = 0, im = 0;
        if (is_counted[i] || !channel->voices[i].is_playing)
            continue;
        for (unsigned j = i; j < VOICES_KEPT; j++) { // those of one frequency interfere
            const struct voice *voice = &channel->voices[j];
            if (is_counted[j] || !voice->is_playing ||
                voice->frequency != channel->voices[i].frequency)
                continue;
            struct complex pointer = voice_pointer(voice, clock, before);
            re += pointer.re;
            im += pointer.im;
            is_counted[j] = true;
        }
        size += magnitude(re, im);
    }
    uint64_t level = (size * LEVEL_PER_UNIT + ONE / 2) / ONE;
    return level > LEVEL_PER_UNIT ? LEVEL_PER_UNIT : (uint16_t)level;
}

int64_t channel_sum(struct channel *channel, uint32_t clock)
{
    int64_t sum = 0;
    for (unsigned i = 0; i < VOICES_KEPT; i++)
        if (channel->voices[i].is_playing)
            sum += voice_sample(&channel->voices[i], clock);
    return sum;
}
