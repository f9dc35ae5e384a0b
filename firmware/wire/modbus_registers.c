// SPDX-License-Identifier: MIT

#include "modbus_registers.h"
#include "capabilities.h"

#include <string.h>

enum controlword { DISARM = 0, STOP = 2, ARM = 15, CLEAR = 128 };

#define TEXT_REGISTERS 16
#define CHANNEL_REGISTERS 4
#define FAULT_REGISTERS 4

// Flags of a channel: keep phase and skip ending as everywhere, then the slots of its envelopes.
#define ONSET_SHIFT 4
#define ENDING_SHIFT 10
#define SLOT_MASK 63

static uint16_t text_register(const char *text, uint16_t number)
{
    size_t size = strlen(text), at = 2u * number;
    uint8_t high = at < size ? (uint8_t)text[at] : 0;
    uint8_t low = at + 1 < size ? (uint8_t)text[at + 1] : 0;
    return (uint16_t)(high << 8 | low);
}

static uint16_t status_field(const struct modbus *modbus, uint16_t field)
{
    const struct amplifier *amplifier = modbus->amplifier;
    const uint16_t head[] = {
        (uint16_t)amplifier->state,
        (uint16_t)amplifier->fault,
        amplifier->active.token,
        amplifier_flags(amplifier),
        amplifier->measured.voltage,
        (uint16_t)amplifier->measured.temperature,
        amplifier_watchdog_left(amplifier),
        amplifier->latch,
        CHANNELS,
    };
    uint16_t size = sizeof head / sizeof head[0];
    return field < size ? head[field] : channel_level(&amplifier->channels[field - size]);
}

static uint16_t refusal_field(const struct modbus *modbus, uint16_t field)
{
    const uint16_t fields[] = {(uint16_t)modbus->refusal.nak, modbus->refusal.channel,
                               modbus->refused_tag};
    return fields[field];
}

static uint16_t capabilities_field(const struct modbus *modbus, uint16_t field)
{
    (void)modbus;
    if (field < CAPABILITY_COUNT)
        return capability_at(field).value;
    field = (uint16_t)(field - CAPABILITY_COUNT);
    return field < CHANNELS * LIMIT_COUNT ? channel_limit(field % LIMIT_COUNT) : 0;
}

static uint16_t identity_field(const struct modbus *modbus, uint16_t field)
{
    const char *texts[] = {VENDOR, PRODUCT, modbus->amplifier->serial_number, FIRMWARE_VERSION};
    if (field == 0)
        return 1 << PROTOCOL_VERSION;
    field--;
    return text_register(texts[field / TEXT_REGISTERS], field % TEXT_REGISTERS);
}

static uint16_t channel_register(const struct command *command, uint16_t number)
{
    switch (number) {
    case 0:
        return command->frequency;
    case 1:
        return command->level;
    case 2:
        return (uint16_t)command->phase;
    default:
        return (uint16_t)((command->flags & (KEEP_PHASE | SKIP_ENDING)) |
                          command->onset << ONSET_SHIFT | command->ending << ENDING_SHIFT);
    }
}

static uint16_t achieved_field(const struct modbus *modbus, uint16_t field)
{
    const struct amplifier *amplifier = modbus->amplifier;
    const struct set *set = amplifier->answered;
    const uint16_t head[] = {(uint16_t)amplifier->state, (uint16_t)amplifier->fault, set->token,
                             CHANNELS};
    if (field < sizeof head / sizeof head[0])
        return head[field];
    field = (uint16_t)(field - sizeof head / sizeof head[0]);
    for (unsigned i = 0; i < set->count; i++)
        if (set->commands[i].channel == field / CHANNEL_REGISTERS)
            return channel_register(&set->commands[i], field % CHANNEL_REGISTERS);
    return 0;
}

static uint16_t faults_field(const struct modbus *modbus, uint16_t field)
{
    const struct amplifier *amplifier = modbus->amplifier;
    if (field == 0)
        return amplifier->fault_count;
    field--;
    uint8_t number = (uint8_t)(field / FAULT_REGISTERS);
    if (number >= amplifier->fault_count)
        return 0;
    uint32_t age = amplifier_fault_age(amplifier, number);
    const uint16_t record[] = {amplifier->faults[number].fault, amplifier->faults[number].channel,
                               (uint16_t)(age >> 16), (uint16_t)age};
    return record[field % FAULT_REGISTERS];
}

static uint16_t control_field(const struct modbus *modbus, uint16_t field)
{
    return modbus->control[field];
}

static uint16_t heartbeat_field(const struct modbus *modbus, uint16_t field)
{
    (void)field;
    return modbus->heartbeat;
}

static uint16_t set_field(const struct modbus *modbus, uint16_t field)
{
    return modbus->set[field];
}

static uint16_t envelope_field(const struct modbus *modbus, uint16_t field)
{
    return modbus->envelope[field];
}

static const struct block {
    uint16_t at, fields;
    uint16_t (*read)(const struct modbus *modbus, uint16_t field);
} BLOCKS[] = {
    {CONTROL_AT, CONTROL_FIELDS, control_field},
    {HEARTBEAT_AT, 1, heartbeat_field},
    {SET_AT, SET_FIELDS, set_field},
    {ENVELOPE_AT, ENVELOPE_FIELDS, envelope_field},
    {STATUS_AT, 9 + CHANNELS_MAX, status_field},
    {REFUSAL_AT, 3, refusal_field},
    {CAPABILITIES_AT, CAPABILITY_COUNT + CHANNELS_MAX * LIMIT_COUNT, capabilities_field},
    {IDENTITY_AT, 1 + 4 * TEXT_REGISTERS, identity_field},
    {ACHIEVED_AT, 4 + CHANNELS_MAX * CHANNEL_REGISTERS, achieved_field},
    {FAULTS_AT, 1 + FAULTS_KEPT * FAULT_REGISTERS, faults_field},
};

uint16_t modbus_read(const struct modbus *modbus, uint16_t address)
{
    if (address == LOOK_AT)
        return modbus->tag;
    for (unsigned i = 0; i < sizeof BLOCKS / sizeof BLOCKS[0]; i++) {
        const struct block *block = &BLOCKS[i];
        if (address == block->at - TAG_BEFORE)
            return modbus->tag;
        if (address >= block->at && address < block->at + block->fields)
            return block->read(modbus, (uint16_t)(address - block->at));
    }
    return 0;
}

// The block may end after any of its registers: those left out are as written last.
static struct verdict write_control(struct modbus *modbus, const uint16_t *written, uint16_t count)
{
    uint16_t fields[CONTROL_FIELDS];
    if (count < 1 || count > CONTROL_FIELDS)
        return refused(NAK_BAD_LENGTH);
    memcpy(fields, modbus->control, sizeof fields);
    memcpy(fields, written, count * sizeof fields[0]);
    switch (fields[0]) {
    case ARM:
        return amplifier_arm(modbus->amplifier, fields[1], fields[3]);
    case DISARM:
        amplifier_disarm(modbus->amplifier, fields[2]);
        return ACCEPTED;
    case STOP:
        amplifier_stop(modbus->amplifier, fields[2]);
        return ACCEPTED;
    case CLEAR:
        if (fields[4] > UINT8_MAX)
            return refused(NAK_BAD_VALUE);
        return amplifier_clear(modbus->amplifier, (uint8_t)fields[4]);
    default:
        return refused(NAK_BAD_VALUE);
    }
}

static struct verdict add_channel(struct set *set, uint8_t channel, const uint16_t *registers)
{
    struct command command = {0};
    uint16_t flags = registers[3];
    if (registers[0] == 0 && registers[1] == 0 && registers[2] == 0 && flags == 0)
        return ACCEPTED; // no command
    command.channel = channel;
    command.frequency = registers[0];
    command.level = registers[1];
    command.phase = (int16_t)registers[2];
    command.onset = flags >> ONSET_SHIFT & SLOT_MASK;
    command.ending = flags >> ENDING_SHIFT & SLOT_MASK;
    command.flags = flags & (KEEP_PHASE | SKIP_ENDING);
    if (command.onset || command.ending)
        command.flags |= HAS_ENVELOPES;
    if ((flags & 0xC) != 0) { // undefined
        struct verdict bad = {NAK_BAD_VALUE, channel};
        return bad;
    }
    return set_add(set, &command);
}

// Up to the session it is a Commit. Else the token that is written twice says whether to play.
static struct verdict write_set(struct modbus *modbus, const uint16_t *fields, uint16_t count)
{
    struct set set = {0};
    if (count == 2)
        return amplifier_commit(modbus->amplifier, fields[1], fields[0]);
    if (count < 5 || count > SET_FIELDS || (count - 5) % CHANNEL_REGISTERS != 0)
        return refused(NAK_BAD_LENGTH);
    set.token = fields[2];
    set.ramp = fields[3];
    set.valid_for = fields[4];
    for (uint16_t i = 5; i < count; i = (uint16_t)(i + CHANNEL_REGISTERS)) {
        struct verdict verdict = add_channel(&set, (uint8_t)((i - 5) / CHANNEL_REGISTERS), fields + i);
        if (verdict.nak != NAK_NONE)
            return verdict;
    }
    if (fields[0] == 0)
        return amplifier_stage(modbus->amplifier, fields[1], &set);
    if (fields[0] != set.token)
        return refused(NAK_BAD_TOKEN);
    return amplifier_apply(modbus->amplifier, fields[1], &set);
}

static struct verdict write_envelope(struct modbus *modbus, const uint16_t *fields, uint16_t count)
{
    struct envelope envelope = {0};
    if (count < 3)
        return refused(NAK_BAD_LENGTH);
    if (fields[0] > ENVELOPE_SLOTS || fields[2] > ENVELOPE_KNOTS)
        return refused(NAK_BAD_VALUE);
    if (count != 3 + 2 * fields[2])
        return refused(NAK_BAD_LENGTH);
    envelope.step = fields[1];
    envelope.knots = (uint8_t)fields[2];
    for (unsigned i = 0; i < envelope.knots; i++) {
        envelope.knot[i].level = fields[3 + 2 * i];
        envelope.knot[i].phase = (int16_t)fields[4 + 2 * i];
    }
    return amplifier_load(modbus->amplifier, (uint8_t)fields[0], &envelope);
}

// What was accepted is kept, to be read.
static struct verdict keep(struct verdict verdict, uint16_t *kept, const uint16_t *fields,
                           uint16_t count)
{
    if (verdict.nak == NAK_NONE)
        memcpy(kept, fields, count * sizeof *kept);
    return verdict;
}

struct verdict modbus_write(struct modbus *modbus, uint16_t first_field, const uint16_t *fields,
                            uint16_t count)
{
    switch (first_field) {
    case CONTROL_AT:
        return keep(write_control(modbus, fields, count), modbus->control, fields, count);
    case HEARTBEAT_AT:
        if (count != 1)
            return refused(NAK_BAD_LENGTH);
        return keep(amplifier_ping(modbus->amplifier, fields[0]), &modbus->heartbeat, fields, 1);
    case SET_AT:
        return keep(write_set(modbus, fields, count), modbus->set, fields, count);
    default:
        return keep(write_envelope(modbus, fields, count), modbus->envelope, fields, count);
    }
}
