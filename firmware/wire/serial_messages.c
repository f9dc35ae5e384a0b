// SPDX-License-Identifier: MIT

#include "serial_messages.h"
#include "capabilities.h"

#include <string.h>

enum type {
    HELLO = 1, GET_CAPS, ARM, DISARM, STAGE, COMMIT, APPLY, STOP, GET_STATUS, GET_FAULTS, CLEAR,
    PING, LOAD_ENVELOPE, SET_ADDRESS = 15,
    NAK = 31
};

static void write_text(struct writer *writer, const char *text)
{
    uint8_t length = (uint8_t)strlen(text);
    write_u8(writer, length);
    for (uint8_t i = 0; i < length; i++)
        write_u8(writer, (uint8_t)text[i]);
}

static void write_identity(struct writer *writer, const struct amplifier *amplifier)
{
    write_u16(writer, 1 << PROTOCOL_VERSION);
    write_text(writer, VENDOR);
    write_text(writer, PRODUCT);
    write_text(writer, amplifier->serial_number);
    write_text(writer, FIRMWARE_VERSION);
}

static void write_capabilities(struct writer *writer)
{
    for (unsigned i = 0; i < CAPABILITY_COUNT; i++) {
        struct capability capability = capability_at(i);
        if (capability.size == 1)
            write_u8(writer, (uint8_t)capability.value);
        else
            write_u16(writer, capability.value);
    }
    for (unsigned i = 0; i < CHANNELS * LIMIT_COUNT; i++)
        write_u16(writer, channel_limit(i % LIMIT_COUNT));
}

static void write_status(struct writer *writer, const struct amplifier *amplifier)
{
    write_u8(writer, (uint8_t)amplifier->state);
    write_u8(writer, (uint8_t)amplifier->fault);
    write_u16(writer, amplifier->active.token);
    write_u8(writer, amplifier_flags(amplifier));
    write_u16(writer, (uint16_t)amplifier->measured.temperature);
    write_u16(writer, amplifier_watchdog_left(amplifier));
    write_u16(writer, amplifier->measured.voltage);
    write_u8(writer, amplifier->latch);
    write_u8(writer, CHANNELS);
    for (unsigned i = 0; i < CHANNELS; i++)
        write_u16(writer, channel_level(&amplifier->channels[i]));
}

// What is really played: this amplifier plays every frequency, level and phase exactly.
static void write_achieved(struct writer *writer, const struct amplifier *amplifier)
{
    const struct set *set = amplifier->answered;
    write_u16(writer, set->token);
    write_u8(writer, set->count);
    for (unsigned i = 0; i < set->count; i++) {
        const struct command *command = &set->commands[i];
        write_u8(writer, command->channel);
        write_u8(writer, command->flags);
        write_u16(writer, command->frequency);
        write_u16(writer, command->level);
        write_u16(writer, (uint16_t)command->phase);
        if (command->flags & HAS_ENVELOPES) {
            write_u8(writer, command->onset);
            write_u8(writer, command->ending);
        }
    }
}

static void write_faults(struct writer *writer, const struct amplifier *amplifier)
{
    write_u8(writer, amplifier->fault_count);
    for (uint8_t i = 0; i < amplifier->fault_count; i++) {
        write_u8(writer, amplifier->faults[i].fault);
        write_u8(writer, amplifier->faults[i].channel);
        write_u32(writer, amplifier_fault_age(amplifier, i));
    }
}

// Read a set to the end of the payload. A channel at fault ends it, since what follows has no place.
static struct verdict read_set(struct reader *payload, struct set *set)
{
    memset(set, 0, sizeof *set);
    set->token = read_u16(payload);
    set->ramp = read_u16(payload);
    set->valid_for = read_u16(payload);
    uint8_t count = read_u8(payload);
    for (uint8_t i = 0; i < count && !payload->is_short; i++) {
        struct command command = {0};
        command.channel = read_u8(payload);
        command.flags = read_u8(payload);
        command.frequency = read_u16(payload);
        command.level = read_u16(payload);
        command.phase = read_i16(payload);
        if (command.flags & HAS_ENVELOPES) {
            command.onset = read_u8(payload);
            command.ending = read_u8(payload);
        }
        if (payload->is_short)
            break;
        struct verdict verdict = set_add(set, &command);
        if (verdict.nak != NAK_NONE)
            return verdict;
    }
    return is_read_whole(payload) ? ACCEPTED : refused(NAK_BAD_LENGTH);
}

static struct verdict play(struct amplifier *amplifier, enum type type, struct reader *payload)
{
    uint16_t session = read_u16(payload);
    struct set set;
    struct verdict verdict = read_set(payload, &set);
    if (verdict.nak != NAK_NONE)
        return verdict;
    return type == STAGE ? amplifier_stage(amplifier, session, &set)
                         : amplifier_apply(amplifier, session, &set);
}

static struct verdict load(struct amplifier *amplifier, struct reader *payload, struct writer *reply)
{
    struct envelope envelope = {0};
    uint8_t slot = read_u8(payload);
    envelope.step = read_u16(payload);
    envelope.knots = read_u8(payload);
    for (uint8_t i = 0; i < envelope.knots && i < ENVELOPE_KNOTS; i++) {
        envelope.knot[i].level = read_u16(payload);
        envelope.knot[i].phase = read_i16(payload);
    }
    if (envelope.knots > ENVELOPE_KNOTS)
        return refused(NAK_BAD_VALUE);
    if (!is_read_whole(payload))
        return refused(NAK_BAD_LENGTH);
    struct verdict verdict = amplifier_load(amplifier, slot, &envelope);
    write_u8(reply, slot);
    write_u8(reply, envelope.knots);
    return verdict;
}

// Whether a SetAddress names another amplifier, or nothing that could be one.
static bool is_for_another(const struct amplifier *amplifier, struct reader payload)
{
    read_u8(&payload); // address
    uint16_t length = read_u8(&payload);
    return payload.is_short || payload.left != length ||
           !amplifier_is_named(amplifier, payload.at, length);
}

// Take an address from a SetAddress for this amplifier.
static struct verdict take_address(const struct amplifier *amplifier, uint8_t *address,
                                   struct reader *payload)
{
    uint8_t given = read_u8(payload);
    struct verdict verdict = amplifier_readdress(amplifier, given, ADDRESS_MAX);
    if (verdict.nak == NAK_NONE)
        *address = given;
    return verdict;
}

// Bytes of a request whose length is fixed; -1: of any length, -2: no such request.
static int length_of(uint8_t type)
{
    static const int8_t LENGTHS[] = {
        [HELLO] = -1, [GET_CAPS] = 0, [ARM] = 4, [DISARM] = 2, [STAGE] = -1, [COMMIT] = 4,
        [APPLY] = -1, [STOP] = 2, [GET_STATUS] = 0, [GET_FAULTS] = 0, [CLEAR] = 1, [PING] = 2,
        [LOAD_ENVELOPE] = -1,
    };
    if (type == SET_ADDRESS)
        return FEATURES & FEATURE_ADDRESS ? -1 : -2;
    return type >= HELLO && type <= LOAD_ENVELOPE ? LENGTHS[type] : -2;
}

static struct verdict carry_out(struct amplifier *amplifier, uint8_t *address, uint8_t type,
                                struct reader *payload, struct writer *reply)
{
    struct verdict verdict = ACCEPTED;
    int length = length_of(type);
    if (length == -2)
        return refused(NAK_UNKNOWN_TYPE);
    if (length >= 0 && payload->left != length)
        return refused(NAK_BAD_LENGTH);
    uint16_t first = length >= 2 ? read_u16(payload) : 0;
    switch (type) {
    case GET_CAPS:
        write_capabilities(reply);
        return ACCEPTED;
    case GET_FAULTS:
        write_faults(reply, amplifier);
        return ACCEPTED;
    case LOAD_ENVELOPE:
        return load(amplifier, payload, reply);
    case SET_ADDRESS:
        verdict = take_address(amplifier, address, payload);
        write_u8(reply, *address);
        return verdict;
    case STAGE:
    case APPLY:
        verdict = play(amplifier, type, payload);
        write_achieved(reply, amplifier);
        return verdict;
    case COMMIT:
        verdict = amplifier_commit(amplifier, first, read_u16(payload));
        write_achieved(reply, amplifier);
        return verdict;
    case ARM:
        verdict = amplifier_arm(amplifier, first, read_u16(payload));
        break;
    case DISARM:
        amplifier_disarm(amplifier, first);
        break;
    case STOP:
        amplifier_stop(amplifier, first);
        break;
    case CLEAR:
        verdict = amplifier_clear(amplifier, read_u8(payload));
        break;
    case PING:
        verdict = amplifier_ping(amplifier, first);
        break;
    default: // GET_STATUS
        break;
    }
    write_status(reply, amplifier);
    return verdict;
}

struct header serial_answer(struct amplifier *amplifier, uint8_t *address, uint8_t type,
                            uint8_t version, struct reader *payload, struct writer *reply)
{
    struct header header = {(uint8_t)(type | REPLY), PROTOCOL_VERSION};
    const struct header none = {0, 0};
    struct verdict verdict = refused(NAK_UNSUPPORTED_VERSION);
    uint16_t start = reply->length;
    if (type == HELLO) { // the same in every version
        write_identity(reply, amplifier);
        header.version = 0;
        return header;
    }
    if (version == PROTOCOL_VERSION && type == SET_ADDRESS && length_of(type) == -1 &&
        is_for_another(amplifier, *payload))
        return none;
    if (version == PROTOCOL_VERSION)
        verdict = carry_out(amplifier, address, type, payload, reply);
    if (verdict.nak != NAK_NONE) {
        reply->length = start;
        write_u8(reply, type);
        write_u8(reply, (uint8_t)verdict.nak);
        write_u8(reply, verdict.channel);
        header.type = NAK | REPLY;
        if (verdict.nak == NAK_UNSUPPORTED_VERSION)
            header.version = 0;
    }
    return header;
}

void serial_broadcast(struct amplifier *amplifier, uint8_t *address, uint8_t type, uint8_t version,
                      struct reader *payload)
{
    if (version == PROTOCOL_VERSION && type == SET_ADDRESS && !is_for_another(amplifier, *payload))
        take_address(amplifier, address, payload);
    if (version != PROTOCOL_VERSION || payload->left != length_of(type))
        return;
    uint16_t first = read_u16(payload);
    if (type == COMMIT)
        amplifier_commit(amplifier, first, read_u16(payload));
    if (type == STOP)
        amplifier_stop(amplifier, first);
}
