// SPDX-License-Identifier: MIT

#include "can.h"
#include "crc.h"
#include "messages.h"

#include <string.h>

#define NO_OBJECT UINT32_C(0x06020000)
#define NO_SUBINDEX UINT32_C(0x06090011)
#define READ_ONLY UINT32_C(0x06010002)
#define WRONG_LENGTH UINT32_C(0x06070010)

enum object {
    DEVICE_TYPE = 0x1000,
    ERROR_REGISTER = 0x1001,
    EMERGENCY_ID = 0x1014,
    HEARTBEAT_INTERVAL = 0x1017,
    DEVICE = 0x1018,
    IDENTITY = 0x2000,     // four texts, then the versions
    CAPABILITIES = 0x2001, // the words of the reply to GetCaps, one in each subindex
    STATUS = 0x2002        // those of GetStatus
};

struct can_emergency can_emergency(enum fault fault)
{
    static const struct can_emergency EMERGENCIES[] = {EMERGENCY_TABLE};
    return EMERGENCIES[fault];
}

static void put_number(struct can_sdo *into, uint32_t value, uint16_t size)
{
    for (into->length = 0; into->length < size; into->length++)
        into->bytes[into->length] = (uint8_t)(value >> 8 * into->length);
}

static void put_identity(struct can_sdo *into, const struct amplifier *amplifier)
{
    if (into->subindex == TEXTS + 1) {
        put_number(into, 1 << PROTOCOL_VERSION, 2);
        return;
    }
    const char *text = message_text(amplifier, into->subindex - 1u);
    into->length = (uint16_t)strlen(text);
    memcpy(into->bytes, text, into->length);
}

static void put_device(struct can_sdo *into, const struct amplifier *amplifier)
{
    const uint8_t *number = (const uint8_t *)amplifier->serial_number;
    uint32_t crc = crc32_of(number, (uint16_t)strlen(amplifier->serial_number));
    // Vendor is not assigned; product and revision.
    const uint32_t values[] = {0, 1, 1, crc};
    put_number(into, values[into->subindex - 1], 4);
}

// Read an object with subindices: its highest one; 0: the object has none.
static uint16_t read_part(const struct can_node *node, struct can_sdo *into)
{
    struct words words = {.count = 0};
    bool is_here = into->subindex > 0;
    switch (into->index) {
    case DEVICE:
        if (is_here && into->subindex <= 4)
            put_device(into, node->amplifier);
        return 4;
    case IDENTITY:
        if (is_here && into->subindex <= TEXTS + 1)
            put_identity(into, node->amplifier);
        return TEXTS + 1;
    case CAPABILITIES:
        message_handle(node->amplifier, MESSAGE_GET_CAPS, NULL, 0, &words);
        break;
    case STATUS:
        message_handle(node->amplifier, MESSAGE_GET_STATUS, NULL, 0, &words);
        break;
    default:
        return 0;
    }
    if (is_here && into->subindex <= words.count)
        put_number(into, words.words[into->subindex - 1], 2);
    return words.count;
}

static uint32_t read_whole(const struct can_node *node, struct can_sdo *into)
{
    switch (into->index) {
    case DEVICE_TYPE: // no device profile
        put_number(into, 0, 4);
        break;
    case ERROR_REGISTER:
        put_number(into, can_emergency(node->amplifier->fault).error_register, 1);
        break;
    case EMERGENCY_ID:
        put_number(into, 0x80u + node->number, 4);
        break;
    case HEARTBEAT_INTERVAL:
        put_number(into, node->heartbeat_interval, 2);
        break;
    default:
        return NO_OBJECT;
    }
    return into->subindex > 0 ? NO_SUBINDEX : 0;
}

uint32_t can_read_object(const struct can_node *node, struct can_sdo *into)
{
    uint16_t last = read_part(node, into);
    if (last == 0)
        return read_whole(node, into);
    if (into->subindex == 0)
        put_number(into, last, 1);
    return into->subindex > last ? NO_SUBINDEX : 0;
}

uint32_t can_write_object(struct can_node *node, const struct can_sdo *from)
{
    struct can_sdo tried = *from;
    uint32_t code = can_read_object(node, &tried);
    if (code != 0)
        return code;
    if (from->index != HEARTBEAT_INTERVAL)
        return READ_ONLY;
    if (from->length != 2)
        return WRONG_LENGTH;
    node->heartbeat_interval = can_u16(from->bytes);
    return 0;
}
