// SPDX-License-Identifier: MIT

#include "channel.h"
#include "sine.h"

#define SUM_SHIFT 9 // a sum of 271 voices (255 and 16 shortened ones) fits into 32 bits

static bool plays_in(const struct voice *voice, uint8_t layer)
{
    return voice->is_playing && voice->layer == layer && !voice->has_ended;
}

// The silent voice that was sent on its way first, or null: later ones may still be in the converter's
// buffer.
static struct voice *silent_voice(struct channel *channel)
{
    struct voice *first = NULL;
    for (unsigned i = 0; i < VOICES_KEPT; i++) {
        struct voice *voice = &channel->voices[i];
        if (!voice->is_playing && (first == NULL || voice->since < first->since))
            first = voice;
    }
    return first;
}

// A place for another voice: one that is silent, else that of the fade that ends first. There are
// as many more places than voices as one set can cut short.
static struct voice *place(struct channel *channel, uint64_t sample)
{
    struct voice *first = silent_voice(channel);
    if (first != NULL)
        return first;
    first = &channel->voices[0];
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

static uint32_t absolute(int32_t x)
{
    return x < 0 ? 0u - (uint32_t)x : (uint32_t)x;
}

// Magnitude of a complex number: the root of its highest bits (11 to 15), and a step of Newton's, which
// leaves an error below a hundredth of a step of a level.
static uint32_t magnitude(struct complex number)
{
    uint32_t re = absolute(number.re), im = absolute(number.im);
    unsigned shift = 0;
    while ((re | im) >> shift > INT16_MAX)
        shift += 4;
    uint32_t re_high = re >> shift, im_high = im >> shift;
    uint32_t root = square_root(re_high * re_high + im_high * im_high);
    if (root == 0)
        return 0;
    uint32_t rough = root << shift;
    uint64_t rest = (uint64_t)re * re + (uint64_t)im * im - (uint64_t)rough * rough;
    return rough + (uint32_t)(rest >> (shift + 9)) / root * 256; // in 32 bits: rest / (2 * rough)
}

// Magnitude of the sum of the voices of one frequency, from a voice on, in units of 2^-30 of full
// level; they count once. A voice alone needs no angle.
static uint64_t sum_of_frequency(const struct channel *channel, unsigned first, bool is_counted[],
                                 uint64_t sample, uint32_t clock, uint32_t before)
{
    const struct voice *voice = &channel->voices[first];
    struct complex amplitude = voice_amplitude(voice, sample, before);
    int64_t re = 0, im = 0;
    for (unsigned i = first + 1; i < VOICES_KEPT; i++) {
        const struct voice *other = &channel->voices[i];
        if (other->frequency != voice->frequency || !voice_sounded(other, sample, before))
            continue;
        struct complex pointer =
            voice_pointer(other, clock, voice_amplitude(other, sample, before));
        re += pointer.re;
        im += pointer.im;
        is_counted[i] = true;
    }
    if (re == 0 && im == 0)
        return magnitude(amplitude);
    struct complex pointer = voice_pointer(voice, clock, amplitude);
    struct complex sum = {.re = (int32_t)((re + pointer.re) >> SUM_SHIFT),
                          .im = (int32_t)((im + pointer.im) >> SUM_SHIFT)};
    return (uint64_t)magnitude(sum) << SUM_SHIFT;
}

uint16_t channel_level(const struct channel *channel, uint64_t sample, uint32_t clock,
                       uint32_t before)
{
    uint64_t size = 0;
    bool is_counted[VOICES_KEPT] = {false};
    for (unsigned i = 0; i < VOICES_KEPT; i++)
        if (!is_counted[i] && voice_sounded(&channel->voices[i], sample, before))
            size += sum_of_frequency(channel, i, is_counted, sample, clock, before);
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
