// SPDX-License-Identifier: MIT

#include "bytes.h"
#include "can.h"
#include "capabilities.h"
#include "crc.h"

#include <string.h>

#define NO_OBJECT UINT32_C(0x06020000)
#define NO_SUBINDEX UINT32_C(0x06090011)
#define WRITE_ONLY UINT32_C(0x06010001)
#define READ_ONLY UINT32_C(0x06010002)
#define WRONG_LENGTH UINT32_C(0x06070010)

#define GROUPS ((CHANNELS + 3) / 4)

static void write_u64(struct writer *writer, uint64_t value)
{
    write_u32(writer, (uint32_t)value);
    write_u32(writer, (uint32_t)(value >> 32));
}

static void write_bytes(struct writer *writer, const char *text)
{
    while (*text)
        write_u8(writer, (uint8_t)*text++);
}

// Highest subindex of an object with several; 0: it has one value.
static uint8_t highest(uint16_t index)
{
    switch (index) {
    case 0x1016:
        return 1;
    case 0x1018:
        return 4;
    case 0x2000:
        return 5;
    case 0x2001:
        return CAPABILITY_COUNT;
    case 0x2002:
        return 7;
    case 0x2003:
    case 0x2009:
    case 0x200A:
    case 0x200B:
    case 0x2020:
        return CHANNELS;
    case 0x2022:
    case 0x2032:
        return GROUPS;
    case 0x2100:
        return ENVELOPE_SLOTS;
    default:
        return 0;
    }
}

static void read_identity(struct writer *writer, const struct amplifier *amplifier, uint8_t sub)
{
    const char *texts[] = {VENDOR, PRODUCT, amplifier->serial_number, FIRMWARE_VERSION};
    if (sub == 5)
        write_u16(writer, 1 << PROTOCOL_VERSION);
    else
        write_bytes(writer, texts[sub - 1]);
}

static void read_capability(struct writer *writer, uint8_t sub)
{
    struct capability capability = capability_at(sub - 1u);
    uint16_t events = sub == FEATURES_SUB ? FEATURE_EVENTS : 0; // CAN always sends them
    if (capability.size == 1)
        write_u8(writer, (uint8_t)capability.value);
    else
        write_u16(writer, capability.value | events);
}

static void read_status(struct writer *writer, const struct amplifier *amplifier, uint8_t sub)
{
    const uint16_t values[] = {(uint16_t)amplifier->state,
                               (uint16_t)amplifier->fault,
                               amplifier->active.token,
                               amplifier_flags(amplifier),
                               amplifier->measured.voltage,
                               (uint16_t)amplifier->measured.temperature,
                               amplifier_watchdog_left(amplifier)};
    bool is_byte = sub == 1 || sub == 2 || sub == 4;
    write_u8(writer, (uint8_t)values[sub - 1]);
    if (!is_byte)
        write_u8(writer, (uint8_t)(values[sub - 1] >> 8));
}

static void read_achieved(struct writer *writer, const struct set *set)
{
    write_u16(writer, set->token);
    write_u8(writer, set->count);
    for (unsigned i = 0; i < set->count; i++) {
        write_u64(writer, can_command_bits(&set->commands[i]));
        write_u8(writer, set->commands[i].onset);
        write_u8(writer, set->commands[i].ending);
    }
}

static void read_faults(struct writer *writer, const struct amplifier *amplifier)
{
    for (uint8_t i = 0; i < amplifier->fault_count; i++) {
        write_u8(writer, amplifier->faults[i].fault);
        write_u8(writer, amplifier->faults[i].channel);
        write_u32(writer, amplifier_fault_age(amplifier, i));
    }
}

static void read_device(struct writer *writer, const struct amplifier *amplifier, uint8_t sub)
{
    const char *number = amplifier->serial_number;
    uint32_t crc = crc32_of((const uint8_t *)number, (uint16_t)strlen(number));
    write_u32(writer, sub == 4 ? crc : 0); // vendor, product and revision have no number yet
}

// The value of an object and subindex that exist; an abort code, or 0.
static uint32_t read_value(struct writer *writer, const struct can_node *node, uint16_t index,
                           uint8_t sub)
{
    const struct amplifier *amplifier = node->amplifier;
    const struct can_collection *collection = &node->collection;
    switch (index) {
    case 0x1000: // no device profile
        write_u32(writer, 0);
        return 0;
    case 0x1001:
        write_u8(writer, can_error_register(amplifier->fault));
        return 0;
    case 0x1014:
        write_u32(writer, 0x80u + node->number);
        return 0;
    case 0x1016:
        write_u32(writer, node->consumer);
        return 0;
    case 0x1017:
        write_u16(writer, node->heartbeat_interval);
        return 0;
    case 0x1018:
        read_device(writer, amplifier, sub);
        return 0;
    case 0x2000:
        read_identity(writer, amplifier, sub);
        return 0;
    case 0x2001:
        read_capability(writer, sub);
        return 0;
    case 0x2002:
        read_status(writer, amplifier, sub);
        return 0;
    case 0x2003:
        write_u16(writer, channel_level(&amplifier->channels[sub - 1]));
        return 0;
    case 0x2006:
        read_achieved(writer, amplifier->answered);
        return 0;
    case 0x2008:
        read_faults(writer, amplifier);
        return 0;
    case 0x2009:
    case 0x200A:
    case 0x200B:
        write_u16(writer, channel_limit(index - 0x2009u));
        return 0;
    case 0x2020:
        write_u64(writer, collection->commands[sub - 1]);
        return 0;
    case 0x2021:
        write_u64(writer, node->last_order);
        return 0;
    case 0x2022:
        write_u64(writer, collection->slots[sub - 1]);
        return 0;
    case 0x2030:
        write_u64(writer, node->last_answer);
        return 0;
    case 0x2031:
        write_u64(writer, can_condition(node, 0));
        return 0;
    case 0x2032:
        write_u64(writer, can_levels(node, 0));
        return 0;
    case 0x200E:
        return FEATURES & FEATURE_ADDRESS ? WRITE_ONLY : NO_OBJECT;
    case 0x2100:
        return WRITE_ONLY;
    default:
        return NO_OBJECT;
    }
}

uint32_t can_read_object(const struct can_node *node, struct can_sdo *into)
{
    struct writer writer = {into->bytes, 0, SDO_BUFFER, false};
    uint8_t last = highest(into->index);
    uint32_t code = 0;
    if (into->subindex > last)
        code = last > 0 ? NO_SUBINDEX : read_value(&writer, node, into->index, 0);
    else if (last > 0 && into->subindex == 0)
        write_u8(&writer, last);
    else
        code = read_value(&writer, node, into->index, into->subindex);
    if (code == 0 && last == 0 && into->subindex > 0)
        code = NO_SUBINDEX;
    into->length = writer.length;
    return code;
}

static uint32_t abort_code(enum nak nak)
{
    static const uint32_t CODES[] = {
        [NAK_NONE] = 0,
        [NAK_UNKNOWN_TYPE] = 0x06020000,
        [NAK_BAD_LENGTH] = 0x06070010,
        [NAK_BAD_VALUE] = 0x06090030,
        [NAK_BAD_CHANNEL] = 0x06090011,
        [NAK_WRONG_STATE] = 0x08000022,
        [NAK_BAD_TOKEN] = 0x08000020,
        [NAK_BUSY] = 0x060A0023,
        [NAK_UNSUPPORTED_VERSION] = 0x08000000,
        [NAK_NO_ENVELOPE] = 0x08000024,
        [NAK_WRONG_SESSION] = 0x08000025,
        [NAK_WRONG_LATCH] = 0x08000026,
        [NAK_FADING] = 0x08000027,
    };
    return CODES[nak];
}

static enum nak write_envelope(struct amplifier *amplifier, uint8_t slot, struct reader reader)
{
    struct envelope envelope = {0};
    envelope.step = read_u16(&reader);
    envelope.knots = read_u8(&reader);
    if (envelope.knots > ENVELOPE_KNOTS)
        return NAK_BAD_VALUE;
    for (unsigned i = 0; i < envelope.knots; i++) {
        envelope.knot[i].level = read_u16(&reader);
        envelope.knot[i].phase = read_i16(&reader);
    }
    if (!is_read_whole(&reader))
        return NAK_BAD_LENGTH;
    return amplifier_load(amplifier, slot, &envelope).nak;
}

static enum nak write_number(struct can_node *node, struct reader reader)
{
    uint8_t number = read_u8(&reader);
    if (!amplifier_is_named(node->amplifier, reader.at, reader.left))
        return NAK_BAD_VALUE;
    enum nak nak = amplifier_readdress(node->amplifier, number, NODE_MAX).nak;
    if (nak == NAK_NONE)
        node->next_number = number;
    return nak;
}

// Objects that stand for frames act like them, and like them only in operation.
static uint32_t write_frame(struct can_node *node, uint16_t index, uint8_t sub, uint64_t frame)
{
    if (node->nmt != NMT_OPERATIONAL)
        return abort_code(NAK_WRONG_STATE);
    if (index == 0x2020)
        can_command(node, (uint8_t)(sub - 1), frame);
    else if (index == 0x2021)
        can_order(node, frame, false);
    else
        can_slots(node, frame);
    return 0;
}

uint32_t can_write_object(struct can_node *node, const struct can_sdo *from)
{
    struct reader reader = {from->bytes, from->length, false};
    uint8_t sub = from->subindex, last = highest(from->index);
    bool is_named = last > 0 ? sub >= 1 && sub <= last : sub == 0;
    switch (from->index) {
    case 0x1016:
    case 0x1017:
    case 0x200E:
    case 0x2020:
    case 0x2021:
    case 0x2022:
    case 0x2100:
        break;
    default: {
        struct can_sdo tried = {.index = from->index, .subindex = sub};
        uint32_t code = can_read_object(node, &tried);
        return code != 0 ? code : READ_ONLY;
    }
    }
    if (!is_named)
        return NO_SUBINDEX;
    if (from->index == 0x200E)
        return abort_code(write_number(node, reader));
    if (from->index == 0x2100)
        return abort_code(write_envelope(node->amplifier, sub, reader));
    if (from->length != (from->index == 0x1016 ? 4 : from->index == 0x1017 ? 2 : 8))
        return WRONG_LENGTH;
    if (from->index == 0x1017) {
        node->heartbeat_interval = read_u16(&reader);
    } else if (from->index == 0x1016) {
        if (node->amplifier->state == OPERATION_ENABLED)
            return abort_code(NAK_WRONG_STATE); // the session's own
        node->consumer = read_u16(&reader);
        node->consumer |= (uint32_t)read_u16(&reader) << 16;
    } else {
        return write_frame(node, from->index, sub, u64_at(from->bytes));
    }
    return 0;
}
