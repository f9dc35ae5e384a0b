// SPDX-License-Identifier: MIT

#include "set.h"

#include <string.h>

static uint16_t read_number(struct reader *reader)
{
    return (uint16_t)read_word(reader, 0, UINT16_MAX, NAK_NONE);
}

static void read_envelope(struct reader *reader, struct envelope *envelope)
{
    envelope->knots = read_number(reader);
    envelope->step = read_number(reader);
    for (uint16_t i = 0; i < envelope->knots && reader->nak == NAK_NONE; i++) {
        struct knot knot = {.level = read_number(reader)};
        knot.phase = (int16_t)read_number(reader);
        if (i < ENVELOPE_KNOTS)
            envelope->knot[i] = knot;
    }
}

struct layer_head read_layer(struct reader *reader)
{
    uint16_t bits = read_number(reader);
    struct layer_head head = {
        .bits = bits,
        .layer = (uint8_t)FIELD_OF(bits, LAYER_LAYER),
        .after = FIELD_OF(bits, LAYER_AFTER),
        .renew = FIELD_OF(bits, LAYER_RENEW),
        .count = FIELD_OF(bits, LAYER_COUNT),
    };
    head.ramp = read_number(reader);
    head.valid_for = read_number(reader);
    return head;
}

void read_command(struct reader *reader, struct command *command)
{
    uint16_t bits = read_number(reader);
    command->bits = bits;
    command->channel = (uint8_t)FIELD_OF(bits, COMMAND_CHANNEL);
    command->keep_phase = FIELD_OF(bits, COMMAND_KEEP_PHASE);
    command->skip_ending = FIELD_OF(bits, COMMAND_SKIP_ENDING);
    command->has_onset = FIELD_OF(bits, COMMAND_ONSET);
    command->has_ending = FIELD_OF(bits, COMMAND_ENDING);
    command->frequency = read_number(reader);
    command->level = read_number(reader);
    command->phase = (int16_t)read_number(reader);
    if (command->has_onset)
        read_envelope(reader, &command->onset);
    if (command->has_ending)
        read_envelope(reader, &command->ending);
}

void skip_command(struct reader *reader)
{
    struct command command;
    read_command(reader, &command);
}

static bool is_amplitude(uint16_t level, int16_t phase)
{
    return level <= LEVEL_MAX && phase >= WIRE_PHASE_MIN && phase <= WIRE_PHASE_MAX;
}

static bool is_shape(const struct envelope *envelope)
{
    if (envelope->knots > ENVELOPE_KNOTS || envelope->step < ENVELOPE_STEP_MIN ||
        envelope->step > ENVELOPE_STEP_MAX)
        return false;
    for (uint16_t i = 0; i < envelope->knots; i++)
        if (!is_amplitude(envelope->knot[i].level, envelope->knot[i].phase))
            return false;
    return true;
}

static void check_command(struct reader *reader, const struct command *command)
{
    bool is_driven = command->level > 0 || command->has_onset;
    if (command->bits > COMMAND_BITS_MAX || !is_amplitude(command->level, command->phase) ||
        (is_driven && (command->frequency < FREQUENCY_MIN || command->frequency > FREQUENCY_MAX)) ||
        (command->has_onset && !is_shape(&command->onset)) ||
        (command->has_ending && !is_shape(&command->ending)))
        reader_refuse(reader, NAK_BAD_VALUE, command->channel);
}

static void check_commands(struct reader *reader, uint8_t count)
{
    uint16_t channels = 0;
    for (uint8_t i = 0; i < count && reader->nak == NAK_NONE; i++) {
        struct command command;
        read_command(reader, &command);
        if (command.channel >= CHANNELS || (channels >> command.channel & 1))
            reader_refuse(reader, NAK_BAD_CHANNEL, command.channel);
        channels |= (uint16_t)(1 << command.channel);
        check_command(reader, &command);
    }
}

void check_set(struct reader *reader)
{
    uint16_t layers = 0;
    while (reader->left > 0 && reader->nak == NAK_NONE) {
        struct reader whole = *reader;
        for (uint8_t left = read_layer(&whole).count; left > 0; left--)
            skip_command(&whole);
        if (whole.nak != NAK_NONE)
            reader_refuse(reader, whole.nak, NO_CHANNEL);
        struct layer_head head = read_layer(reader);
        if (head.bits > LAYER_BITS_MAX || (layers >> head.layer & 1) ||
            (head.count > 0 ? head.renew : head.after) || head.layer >= LAYERS ||
            head.ramp > RAMP_MAX || head.valid_for > WIRE_VALID_FOR_MAX)
            reader_refuse(reader, NAK_BAD_VALUE, NO_CHANNEL);
        layers |= (uint16_t)(1 << head.layer);
        check_commands(reader, head.count);
    }
}

void intake_drop(struct intake *intake)
{
    intake->token = 0;
    intake->is_staged = intake->is_overlong = false;
    intake->count = 0;
    intake->parts = 0;
    timer_stop(&intake->life);
    memset(intake->lengths, 0, sizeof intake->lengths);
}

uint8_t intake_missing(const struct intake *intake, uint16_t token)
{
    uint8_t index = 0;
    while (intake->token == token && index + 1 < intake->parts && intake->lengths[index] > 0)
        index++;
    return index;
}

// Put the words of a part where they belong, in place of those that came before, if there is room.
static void insert(struct intake *intake, uint8_t index, const struct reader *part)
{
    uint16_t at = 0, before = 0;
    for (uint8_t i = 0; i < index; i++)
        at = (uint16_t)(at + (intake->lengths[i] > 0 ? intake->lengths[i] - 1 : 0));
    if (intake->lengths[index] > 0)
        before = (uint16_t)(intake->lengths[index] - 1);
    intake->lengths[index] = (uint8_t)(part->left + 1);
    if (intake->is_overlong || intake->count - before + part->left > STREAM_WORDS) {
        intake->is_overlong = true; // no words any more; its last part is refused
        return;
    }
    uint16_t *words = intake->words + at;
    uint16_t behind = (uint16_t)(intake->count - at - before);
    memmove(words + part->left, words + before, behind * sizeof *words);
    memcpy(words, part->at, part->left * sizeof *words);
    intake->count = (uint16_t)(intake->count - before + part->left);
}

static void begin(struct intake *intake, uint16_t token, uint8_t parts, uint64_t now)
{
    intake_drop(intake);
    intake->token = token;
    intake->parts = parts;
    timer_start(&intake->life, STAGED_LIFE_MS, now);
}

bool intake_keep(struct intake *intake, uint16_t token, uint16_t bits, const struct reader *part,
                 uint64_t now)
{
    uint8_t parts = FIELD_OF(bits, SET_PARTS);
    if (intake->token != token) {
        if (!is_newer(token, intake->token))
            return false;
        begin(intake, token, parts, now);
    }
    if (intake->parts != parts || intake->is_staged)
        return false;
    insert(intake, (uint8_t)FIELD_OF(bits, SET_INDEX), part);
    return true;
}

enum nak intake_take(struct intake *intake, uint16_t token, uint16_t bits, struct reader *part,
                     uint64_t now)
{
    uint8_t index = (uint8_t)FIELD_OF(bits, SET_INDEX), parts = FIELD_OF(bits, SET_PARTS);
    bool has_begun = intake->token == token;
    struct reader whole = *part;
    if (has_begun && intake->is_staged)
        return NAK_NONE; // it came again
    if (!has_begun && !is_newer(token, intake->token))
        return NAK_BAD_TOKEN;
    if (index >= parts || (has_begun && parts != intake->parts))
        return NAK_BAD_VALUE;
    if (intake_missing(intake, token) < index)
        return NAK_NONE;
    if (has_begun && !intake->is_overlong && intake->count + part->left <= STREAM_WORDS) {
        memcpy(intake->words + intake->count, part->at, part->left * sizeof *part->at);
        whole = reader_of(intake->words, intake->count + part->left);
    } else if (has_begun) {
        whole.nak = NAK_BAD_LENGTH;
    }
    check_set(&whole);
    part->channel = whole.channel;
    if (whole.nak != NAK_NONE) {
        if (has_begun)
            intake_drop(intake);
        return whole.nak;
    }
    if (!has_begun) {
        begin(intake, token, parts, now);
        memcpy(intake->words, part->at, part->left * sizeof *part->at);
    }
    intake->count = (uint16_t)(intake->count + part->left);
    intake->is_staged = true;
    return NAK_NONE;
}
