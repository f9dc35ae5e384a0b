// SPDX-License-Identifier: MIT

#include "channel.h"
#include "sine.h"

#include <stddef.h>

static bool is_silent(const struct command *command)
{
    return command->level == 0 && command->onset == 0;
}

// Keep phase applies to what the channel plays, unless that falls silent, at exactly this frequency.
static bool keeps_phase(const struct channel *channel, const struct command *command)
{
    const struct voice *voice = &channel->voices[channel->newest];
    return (command->flags & KEEP_PHASE) != 0 && voice_lasts(voice) &&
           voice->frequency == command->frequency;
}

// The first voice that does not sound; VOICES if all do.
static uint8_t free_voice(const struct channel *channel)
{
    uint8_t number = 0;
    while (number < VOICES && channel->voices[number].is_sounding)
        number++;
    return number;
}

bool channel_has_room(const struct channel *channel, const struct command *command, uint16_t ramp)
{
    bool needs_no_voice = is_silent(command) || (keeps_phase(channel, command) && command->onset);
    return needs_no_voice || free_voice(channel) < VOICES || ramp == 0;
}

static void fall_all(struct channel *channel, uint16_t ramp)
{
    for (uint8_t i = 0; i < VOICES; i++)
        voice_fall(&channel->voices[i], ramp);
}

static void fall_others(struct channel *channel, uint16_t ramp)
{
    for (uint8_t i = 0; i < VOICES; i++)
        if (i != channel->newest)
            voice_fall(&channel->voices[i], ramp);
}

static struct voice *begin_voice(struct channel *channel, const struct command *command,
                                 struct complex amplitude, uint16_t ramp)
{
    bool is_kept = keeps_phase(channel, command);
    uint32_t angle = channel->voices[channel->newest].angle;
    fall_all(channel, ramp);
    channel->newest = free_voice(channel);
    struct voice *voice = &channel->voices[channel->newest];
    voice_begin(voice, command->frequency, amplitude, command->onset ? 0 : ramp);
    if (is_kept)
        voice->angle = angle;
    return voice;
}

static void play_onset(struct channel *channel, const struct command *command, uint16_t ramp,
                       const struct envelope *onset)
{
    static const struct complex silence = {0, 0};
    struct voice *voice = &channel->voices[channel->newest];
    if (keeps_phase(channel, command))
        fall_others(channel, ramp);
    else
        voice = begin_voice(channel, command, silence, ramp);
    voice_walk(voice, onset, amplitude_of(command->level, command->phase));
}

void channel_play(struct channel *channel, const struct command *command, uint16_t ramp,
                  const struct envelope *onset, const struct envelope *ending)
{
    if (is_silent(command)) {
        if (command->flags & SKIP_ENDING)
            channel_quiet(channel, ramp);
        else
            channel_end(channel, ramp);
        return;
    }
    if (onset != NULL)
        play_onset(channel, command, ramp, onset);
    else
        begin_voice(channel, command, amplitude_of(command->level, command->phase), ramp);
    channel->has_command = true;
    channel->ramp = ramp;
    channel->ending.knots = 0;
    if (ending != NULL)
        channel->ending = *ending;
}

void channel_end(struct channel *channel, uint16_t ramp)
{
    static const struct complex silence = {0, 0};
    struct voice *voice = &channel->voices[channel->newest];
    if (channel->has_command && channel->ending.knots > 0 && voice->is_sounding) {
        fall_others(channel, ramp);
        voice_walk(voice, &channel->ending, silence);
    } else {
        fall_all(channel, ramp);
    }
    channel->has_command = false;
}

void channel_quiet(struct channel *channel, uint16_t ramp)
{
    fall_all(channel, ramp);
    channel->has_command = false;
}

bool channel_is_sounding(const struct channel *channel)
{
    for (uint8_t i = 0; i < VOICES; i++)
        if (channel->voices[i].is_sounding)
            return true;
    return false;
}

uint16_t channel_level(const struct channel *channel)
{
    if (!channel_is_sounding(channel))
        return 0;
    int64_t size = 0;
    for (uint8_t i = 0; i < VOICES; i++)
        size += voice_size(&channel->voices[i]);
    int64_t level = (size * FULL_STROKE + ONE / 2) / ONE;
    if (level < 1)
        return 1;
    return level > FULL_STROKE ? FULL_STROKE : (uint16_t)level;
}

// The voltage u = sqrt((1 + force) / 2): its square is half the full one, the bias, and half the
// force, so that nothing beats and there is no harmonic, whatever the voices play together.
static int16_t voltage_of(int32_t force)
{
    return (int16_t)square_root((uint64_t)(force + INT16_MAX) * INT16_MAX / 2);
}

int32_t channel_force(struct channel *channel)
{
    int64_t sum = 0;
    for (uint8_t i = 0; i < VOICES; i++)
        sum += voice_sample(&channel->voices[i]);
    if (sum > ONE)
        return ONE;
    return sum < -ONE ? -ONE : (int32_t)sum;
}

int16_t sample_of(int32_t force)
{
    int32_t value = (force + (1 << 14)) >> 15;
    if (value > INT16_MAX)
        value = INT16_MAX;
    if (value < -INT16_MAX)
        value = -INT16_MAX;
    return SQUARE_LAW ? voltage_of(value) : (int16_t)value;
}
