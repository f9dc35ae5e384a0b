// SPDX-License-Identifier: MIT

#include "set.h"

#include <string.h>

static uint16_t read_range(struct reader *reader, int32_t high)
{
    return (uint16_t)read_word(reader, 0, high, NAK_BAD_VALUE);
}

static int16_t read_phase(struct reader *reader)
{
    return (int16_t)read_word(reader, WIRE_PHASE_MIN, WIRE_PHASE_MAX, NAK_BAD_VALUE);
}

static void read_envelope(struct reader *reader, struct envelope *envelope)
{
    envelope->knots = (uint8_t)read_range(reader, WIRE_KNOTS_MAX);
    envelope->step = (uint16_t)read_word(reader, WIRE_ENVELOPE_STEP_MIN, WIRE_ENVELOPE_STEP_MAX,
                                         NAK_BAD_VALUE);
    for (uint8_t i = 0; i < envelope->knots; i++) {
        struct knot knot = {.level = read_range(reader, WIRE_LEVEL_MAX)};
        knot.phase = read_phase(reader);
        if (i < ENVELOPE_KNOTS)
            envelope->knot[i] = knot;
    }
}

struct layer_head read_layer(struct reader *reader)
{
    uint16_t bits = read_range(reader, LAYER_BITS_MAX);
    struct layer_head head = {
        .layer = (uint8_t)FIELD_OF(bits, LAYER_LAYER),
        .after = FIELD_OF(bits, LAYER_AFTER),
        .renew = FIELD_OF(bits, LAYER_RENEW),
        .count = FIELD_OF(bits, LAYER_COUNT),
    };
    head.ramp = read_range(reader, WIRE_RAMP_MAX);
    head.valid_for = read_range(reader, WIRE_VALID_FOR_MAX);
    return head;
}

struct command read_command(struct reader *reader)
{
    uint16_t bits = read_range(reader, COMMAND_BITS_MAX);
    struct command command = {
        .channel = (uint8_t)FIELD_OF(bits, COMMAND_CHANNEL),
        .keep_phase = FIELD_OF(bits, COMMAND_KEEP_PHASE),
        .skip_ending = FIELD_OF(bits, COMMAND_SKIP_ENDING),
        .has_onset = FIELD_OF(bits, COMMAND_ONSET),
        .has_ending = FIELD_OF(bits, COMMAND_ENDING),
    };
    command.frequency = read_range(reader, UINT16_MAX);
    command.level = read_range(reader, WIRE_LEVEL_MAX);
    command.phase = read_phase(reader);
    if (command.has_onset)
        read_envelope(reader, &command.onset);
    if (command.has_ending)
        read_envelope(reader, &command.ending);
    return command;
}

// Whether the words are a set at all.
static void check_form(struct reader *reader)
{
    uint16_t layers = 0;
    while (reader->left > 0 && reader->nak == NAK_NONE) {
        struct layer_head head = read_layer(reader);
        uint16_t channels = 0;
        for (uint8_t i = 0; i < head.count && reader->nak == NAK_NONE; i++) {
            struct command command = read_command(reader);
            if (channels >> command.channel & 1)
                reader_refuse(reader, NAK_BAD_CHANNEL, command.channel);
            channels |= (uint16_t)(1 << command.channel);
        }
        if ((head.count > 0 ? head.renew : head.after) || (layers >> head.layer & 1))
            reader_refuse(reader, NAK_BAD_VALUE, NO_CHANNEL);
        layers |= (uint16_t)(1 << head.layer);
    }
}

static void check_shape(struct reader *reader, const struct envelope *envelope, uint8_t channel)
{
    if (envelope->step < ENVELOPE_STEP_MIN || envelope->step > ENVELOPE_STEP_MAX ||
        envelope->knots > ENVELOPE_KNOTS)
        reader_refuse(reader, NAK_BAD_VALUE, channel);
    for (uint8_t i = 0; i < envelope->knots && i < ENVELOPE_KNOTS; i++)
        if (envelope->knot[i].level > LEVEL_MAX)
            reader_refuse(reader, NAK_BAD_VALUE, channel);
}

static void check_command(struct reader *reader, const struct command *command)
{
    uint8_t channel = command->channel;
    bool is_driven = command->level > 0 || command->has_onset;
    if (channel >= CHANNELS)
        reader_refuse(reader, NAK_BAD_CHANNEL, channel);
    if (command->level > LEVEL_MAX ||
        (is_driven && (command->frequency < FREQUENCY_MIN || command->frequency > FREQUENCY_MAX)))
        reader_refuse(reader, NAK_BAD_VALUE, channel);
    if (command->has_onset)
        check_shape(reader, &command->onset, channel);
    if (command->has_ending)
        check_shape(reader, &command->ending, channel);
}

void check_set(struct reader *reader)
{
    struct reader again = *reader;
    check_form(reader);
    if (reader->nak != NAK_NONE)
        return;
    while (again.left > 0 && again.nak == NAK_NONE) {
        struct layer_head head = read_layer(&again);
        if (head.layer >= LAYERS || head.ramp > RAMP_MAX)
            reader_refuse(&again, NAK_BAD_VALUE, NO_CHANNEL);
        for (uint8_t i = 0; i < head.count && again.nak == NAK_NONE; i++) {
            struct command command = read_command(&again);
            check_command(&again, &command);
        }
    }
    *reader = again;
}

void intake_drop(struct intake *intake)
{
    intake->token = 0;
    intake->is_staged = false;
    intake->count = 0;
    intake->parts = 0;
    timer_stop(&intake->life);
    memset(intake->lengths, 0, sizeof intake->lengths);
}

uint8_t intake_missing(const struct intake *intake)
{
    uint8_t index = 0;
    while (index < intake->parts && intake->lengths[index] > 0)
        index++;
    return index < intake->parts ? index : 0;
}

// Put the words of a part where they belong, in place of those that came before; false: no room.
static bool insert(struct intake *intake, uint8_t index, const struct reader *part)
{
    uint16_t at = 0, before = 0;
    for (uint8_t i = 0; i < index; i++)
        at = (uint16_t)(at + (intake->lengths[i] > 0 ? intake->lengths[i] - 1 : 0));
    if (intake->lengths[index] > 0)
        before = (uint16_t)(intake->lengths[index] - 1);
    if (intake->count - before + part->left > STREAM_WORDS)
        return false;
    uint16_t *words = intake->words + at;
    uint16_t behind = (uint16_t)(intake->count - at - before);
    memmove(words + part->left, words + before, behind * sizeof *words);
    memcpy(words, part->at, part->left * sizeof *words);
    intake->count = (uint16_t)(intake->count - before + part->left);
    intake->lengths[index] = (uint8_t)(part->left + 1);
    return true;
}

static bool is_whole(const struct intake *intake)
{
    return intake_missing(intake) == 0 && intake->lengths[0] > 0;
}

enum nak intake_take(struct intake *intake, uint16_t token, uint16_t bits, struct reader *part,
                     uint64_t now)
{
    uint8_t index = (uint8_t)FIELD_OF(bits, SET_INDEX), parts = FIELD_OF(bits, SET_PARTS);
    if (intake->token == token && intake->is_staged)
        return NAK_NONE; // a part came again
    if (intake->token != 0 && token != intake->token && !is_newer(token, intake->token))
        return NAK_BAD_TOKEN;
    if (index >= parts)
        return NAK_BAD_VALUE;
    if (intake->token != token) {
        intake_drop(intake);
        intake->token = token;
        intake->parts = parts;
        timer_start(&intake->life, STAGED_LIFE_MS, now);
    }
    if (intake->parts != parts)
        return NAK_BAD_VALUE;
    if (!insert(intake, index, part)) {
        intake_drop(intake);
        return NAK_BAD_LENGTH;
    }
    if (!is_whole(intake))
        return NAK_NONE;
    struct reader whole = reader_of(intake->words, intake->count);
    check_set(&whole);
    part->channel = whole.channel;
    if (whole.nak != NAK_NONE)
        intake_drop(intake);
    else
        intake->is_staged = true;
    return whole.nak;
}
