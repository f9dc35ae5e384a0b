// SPDX-License-Identifier: MIT

#include "modbus.h"
#include "messages.h"

#include <string.h>

enum function { READ_HOLDING = 3, READ_INPUT = 4, WRITE = 16 };
enum exception { ILLEGAL_FUNCTION = 1, ILLEGAL_ADDRESS = 2, ILLEGAL_VALUE = 3 };

#define EXCEPTION 0x80 // bit of the function
#define READ_MAX 125
#define WRITE_MAX 123
#define BOX 256        // registers of a message
#define REPLY 128      // offset of its reply: tag, result, words
#define REPLY_HEAD 2
#define AREA_MAX (REPLY_HEAD + WORDS_MAX)
#define IDENTITY 1065  // tag, versions, texts
#define TEXT_REGISTERS 16
#define IDENTITY_REGISTERS (2 + TEXTS * TEXT_REGISTERS)

void modbus_init(struct modbus *modbus, struct amplifier *amplifier, uint8_t unit)
{
    memset(modbus, 0, sizeof *modbus);
    modbus->amplifier = amplifier;
    modbus->unit = unit;
}

static uint16_t u16_at(const uint8_t *bytes)
{
    return (uint16_t)(bytes[0] << 8 | bytes[1]);
}

static bool is_known(uint16_t type)
{
    return type >= MESSAGE_GET_CAPS && type < MODBUS_BOXES;
}

// What is read as it is at that moment, so that any master can look.
static bool is_present(uint16_t type)
{
    return type == MESSAGE_GET_CAPS || type == MESSAGE_GET_STATUS || type == MESSAGE_GET_FAULTS;
}

// Carry out a message, a broadcast without a reply (null); return the result: 0, or code and channel of the refusal.
static uint16_t execute(struct modbus *modbus, uint8_t type, const uint16_t *words, uint16_t count,
                        struct words *reply)
{
    struct verdict verdict = message_handle(modbus->amplifier, type, words, count, reply);
    if (verdict.nak != NAK_NONE)
        return (uint16_t)(verdict.nak << 8 | verdict.channel);
    if (type == MESSAGE_SET_ADDRESS)
        modbus->next_unit = (uint8_t)words[SET_ADDRESS_ADDRESS];
    return 0;
}

// The message that is written: its type, and its tag and words; an exception, or 0.
static int read_write(const uint8_t *pdu, uint16_t length, uint8_t *type, uint16_t *words,
                      uint16_t *count)
{
    if (length < 6)
        return ILLEGAL_VALUE;
    uint16_t address = u16_at(pdu + 1);
    *count = u16_at(pdu + 3);
    if (*count < 1 || *count > WRITE_MAX || pdu[5] != 2 * *count || length != 6 + 2 * *count)
        return ILLEGAL_VALUE;
    if (address % BOX != 0 || !is_known(address / BOX) || *count > 1 + WORDS_MAX)
        return ILLEGAL_ADDRESS;
    *type = (uint8_t)(address / BOX);
    for (uint16_t i = 0; i < *count; i++)
        words[i] = u16_at(pdu + 6 + 2 * i);
    return 0;
}

static int write_box(struct modbus *modbus, const uint8_t *pdu, uint16_t length)
{
    uint16_t words[1 + WORDS_MAX], count;
    uint8_t type;
    struct words reply;
    int exception = read_write(pdu, length, &type, words, &count);
    if (exception != 0)
        return exception;
    uint16_t result = execute(modbus, type, words + 1, (uint16_t)(count - 1), &reply);
    modbus->replies[type].tag = words[0];
    modbus->replies[type].result = result;
    modbus->replies[type].count = result == 0 && !is_present(type) ? reply.count : 0;
    memcpy(modbus->replies[type].words, reply.words,
           modbus->replies[type].count * sizeof reply.words[0]);
    return 0;
}

// The registers of a reply, with zeros behind it.
static void read_reply(struct modbus *modbus, uint8_t type, uint16_t area[AREA_MAX])
{
    struct words reply = {.count = 0};
    area[0] = modbus->replies[type].tag;
    area[1] = modbus->replies[type].result;
    if (!is_present(type)) {
        reply.count = modbus->replies[type].count;
        memcpy(reply.words, modbus->replies[type].words, reply.count * sizeof reply.words[0]);
    } else if (area[1] == 0) {
        area[1] = execute(modbus, type, NULL, 0, &reply);
    }
    if (is_present(type)) // a refusal is read once
        modbus->replies[type].result = 0;
    for (uint16_t i = 0; i < WORDS_MAX; i++)
        area[REPLY_HEAD + i] = i < reply.count ? reply.words[i] : 0;
}

static void read_identity(const struct modbus *modbus, uint16_t area[AREA_MAX])
{
    area[0] = 0;
    area[1] = 1 << PROTOCOL_VERSION;
    for (uint16_t i = 0; i < TEXTS * TEXT_REGISTERS; i++) {
        const char *text = message_text(modbus->amplifier, i / TEXT_REGISTERS);
        size_t size = strlen(text), at = 2u * (i % TEXT_REGISTERS);
        uint8_t high = at < size ? (uint8_t)text[at] : 0;
        uint8_t low = at + 1 < size ? (uint8_t)text[at + 1] : 0;
        area[2 + i] = (uint16_t)(high << 8 | low);
    }
}

// Read registers; an exception, or 0.
static int read_registers(struct modbus *modbus, uint16_t address, uint16_t count, uint8_t *reply)
{
    uint16_t type = address / BOX, area[AREA_MAX], first = IDENTITY, size = IDENTITY_REGISTERS;
    bool is_reply = address % BOX >= REPLY && is_known(type);
    if (is_reply) {
        first = (uint16_t)(type * BOX + REPLY);
        size = AREA_MAX;
    }
    if (address < first || address + count > first + size)
        return ILLEGAL_ADDRESS;
    if (is_reply)
        read_reply(modbus, (uint8_t)type, area);
    else
        read_identity(modbus, area);
    for (uint16_t i = 0; i < count; i++) {
        uint16_t word = area[address - first + i];
        reply[2 + 2 * i] = (uint8_t)(word >> 8);
        reply[3 + 2 * i] = (uint8_t)word;
    }
    if (type == MESSAGE_SET_ADDRESS && modbus->replies[type].result == 0 && modbus->next_unit > 0)
        modbus->unit = modbus->next_unit;
    return 0;
}

uint16_t modbus_request(struct modbus *modbus, const uint8_t *pdu, uint16_t length,
                        uint8_t reply[MODBUS_PDU_MAX])
{
    int exception = ILLEGAL_FUNCTION;
    uint16_t size = 5, count = length == 5 ? u16_at(pdu + 3) : 0;
    if (length > 0 && pdu[0] == WRITE) {
        exception = write_box(modbus, pdu, length);
        if (exception == 0)
            memcpy(reply, pdu, size); // function, address and count
    } else if (length > 0 && (pdu[0] == READ_HOLDING || pdu[0] == READ_INPUT)) {
        exception = count < 1 || count > READ_MAX
                        ? ILLEGAL_VALUE
                        : read_registers(modbus, u16_at(pdu + 1), count, reply);
        reply[0] = pdu[0];
        reply[1] = (uint8_t)(2 * count);
        size = (uint16_t)(2 + 2 * count);
    }
    if (exception == 0)
        return size;
    reply[0] = (length > 0 ? pdu[0] : 0) | EXCEPTION;
    reply[1] = (uint8_t)exception;
    return 2;
}

void modbus_broadcast(struct modbus *modbus, const uint8_t *pdu, uint16_t length)
{
    uint16_t words[1 + WORDS_MAX], count;
    uint8_t type;
    if (length == 0 || pdu[0] != WRITE || read_write(pdu, length, &type, words, &count) != 0)
        return;
    if (execute(modbus, type, words + 1, (uint16_t)(count - 1), NULL) == 0 &&
        type == MESSAGE_SET_ADDRESS)
        modbus->unit = modbus->next_unit;
}
