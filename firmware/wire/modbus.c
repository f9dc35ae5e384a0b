// SPDX-License-Identifier: MIT

#include "modbus.h"
#include "modbus_registers.h"

#include <string.h>

enum function {
    READ_HOLDING = 3,
    READ_INPUT = 4,
    WRITE = 16,
    WRITE_AND_READ = 23
};

#define EXCEPTION 0x80 // bit of the function
enum exception { ILLEGAL_FUNCTION = 1, ILLEGAL_ADDRESS = 2, ILLEGAL_VALUE = 3, FAILURE = 4, BUSY = 6 };

#define READ_MAX 125
#define WRITE_MAX 123

void modbus_init(struct modbus *modbus, struct amplifier *amplifier, uint8_t unit)
{
    memset(modbus, 0, sizeof *modbus);
    modbus->amplifier = amplifier;
    modbus->unit = unit;
    modbus->refusal = ACCEPTED;
    modbus->control[1] = 250; // watchdog, ms
    modbus->control[2] = 5;   // ramp, ms
}

static uint16_t u16_at(const uint8_t *bytes)
{
    return (uint16_t)(bytes[0] << 8 | bytes[1]);
}

static void put_u16(uint8_t *bytes, uint16_t value)
{
    bytes[0] = (uint8_t)(value >> 8);
    bytes[1] = (uint8_t)value;
}

static uint16_t exception(uint8_t *reply, uint8_t function, enum exception code)
{
    reply[0] = function | EXCEPTION;
    reply[1] = (uint8_t)code;
    return 2;
}

static enum exception exception_of(enum nak nak)
{
    switch (nak) {
    case NAK_UNKNOWN_TYPE:
        return ILLEGAL_FUNCTION;
    case NAK_WRONG_STATE:
    case NAK_WRONG_SESSION:
    case NAK_WRONG_LATCH:
    case NAK_FADING:
        return FAILURE;
    case NAK_BUSY:
        return BUSY;
    default:
        return ILLEGAL_VALUE;
    }
}

static bool is_range(uint16_t address, uint16_t count)
{
    return address + count <= REGISTERS_END;
}

static uint16_t read_registers(const struct modbus *modbus, uint8_t function, uint16_t address,
                               uint16_t count, uint8_t *reply)
{
    reply[0] = function;
    reply[1] = (uint8_t)(2 * count);
    for (uint16_t i = 0; i < count; i++)
        put_u16(&reply[2 + 2 * i], modbus_read(modbus, (uint16_t)(address + i)));
    return (uint16_t)(2 + 2 * count);
}

// Write a block from its tag or its first field on; return 0, or an exception.
static int write_block(struct modbus *modbus, uint16_t address, const uint8_t *bytes, uint16_t count)
{
    static const uint16_t BLOCKS[] = {CONTROL_AT, HEARTBEAT_AT, SET_AT, ENVELOPE_AT};
    uint16_t values[WRITE_MAX];
    for (uint16_t i = 0; i < count; i++)
        values[i] = u16_at(bytes + 2 * i);
    if (address == LOOK_AT && count == 1) {
        modbus->tag = values[0];
        return 0;
    }
    struct verdict verdict = refused(NAK_BAD_VALUE);
    int code = ILLEGAL_ADDRESS;
    uint16_t tag = 0;
    for (unsigned i = 0; i < sizeof BLOCKS / sizeof BLOCKS[0]; i++) {
        uint16_t skipped = address == BLOCKS[i] ? 0 : TAG_BEFORE;
        if (address + skipped != BLOCKS[i] || count < skipped)
            continue;
        if (skipped > 0)
            modbus->tag = tag = values[0];
        verdict = modbus_write(modbus, BLOCKS[i], values + skipped, (uint16_t)(count - skipped));
        if (verdict.nak == NAK_NONE)
            return 0;
        code = exception_of(verdict.nak);
    }
    modbus->refusal = verdict;
    modbus->refused_tag = tag;
    return code;
}

static uint16_t write_request(struct modbus *modbus, const uint8_t *pdu, uint16_t length,
                              uint8_t *reply)
{
    uint16_t address = u16_at(pdu + 1), count = u16_at(pdu + 3);
    if (count < 1 || count > WRITE_MAX || pdu[5] != 2 * count || length != 6 + 2 * count)
        return exception(reply, WRITE, ILLEGAL_VALUE);
    int code = write_block(modbus, address, pdu + 6, count);
    if (code != 0)
        return exception(reply, WRITE, (enum exception)code);
    memcpy(reply, pdu, 5);
    return 5;
}

static uint16_t write_and_read_request(struct modbus *modbus, const uint8_t *pdu, uint16_t length,
                                       uint8_t *reply)
{
    uint16_t from = u16_at(pdu + 1), wanted = u16_at(pdu + 3);
    uint16_t address = u16_at(pdu + 5), count = u16_at(pdu + 7);
    if (wanted < 1 || wanted > READ_MAX || count < 1 || count > WRITE_MAX - 2 ||
        pdu[9] != 2 * count || length != 10 + 2 * count)
        return exception(reply, WRITE_AND_READ, ILLEGAL_VALUE);
    if (!is_range(from, wanted))
        return exception(reply, WRITE_AND_READ, ILLEGAL_ADDRESS);
    int code = write_block(modbus, address, pdu + 10, count);
    if (code != 0)
        return exception(reply, WRITE_AND_READ, (enum exception)code);
    return read_registers(modbus, WRITE_AND_READ, from, wanted, reply);
}

static uint16_t read_request(struct modbus *modbus, const uint8_t *pdu, uint16_t length,
                             uint8_t *reply)
{
    uint16_t address = u16_at(pdu + 1), count = u16_at(pdu + 3);
    if (length != 5 || count < 1 || count > READ_MAX)
        return exception(reply, pdu[0], ILLEGAL_VALUE);
    if (!is_range(address, count))
        return exception(reply, pdu[0], ILLEGAL_ADDRESS);
    return read_registers(modbus, pdu[0], address, count, reply);
}

// Take a unit number, from a write of the whole address block that names this amplifier.
static void take_unit(struct modbus *modbus, const uint8_t *registers)
{
    uint8_t length = SERIAL_NUMBER_MAX; // without the zeros behind it
    while (length > 0 && registers[1 + length] == 0)
        length--;
    uint16_t unit = u16_at(registers);
    if (amplifier_is_named(modbus->amplifier, registers + 2, length) &&
        amplifier_readdress(modbus->amplifier, unit, ADDRESS_MAX).nak == NAK_NONE)
        modbus->unit = (uint8_t)unit;
}

// To all units: a Commit, Stop or SetAddress is carried out, anything else ignored.
static void broadcast(struct modbus *modbus, const uint8_t *pdu, uint16_t length, uint8_t *reply)
{
    uint16_t address = u16_at(pdu + 1), count = u16_at(pdu + 3);
    uint16_t first = SET_AT, fields = 2;
    if (address == ADDRESS_AT || address == ADDRESS_AT - TAG_BEFORE) {
        if (address + count == ADDRESS_AT + ADDRESS_FIELDS && pdu[5] == 2 * count &&
            length == 6 + 2 * count)
            take_unit(modbus, pdu + 6 + 2 * (ADDRESS_AT - address));
        return;
    }
    if (address == CONTROL_AT || address == CONTROL_AT - TAG_BEFORE) {
        uint16_t word = (uint16_t)(6 + 2 * (CONTROL_AT - address));
        if (length < word + 2 || u16_at(pdu + word) != 2)
            return;
        first = CONTROL_AT;
        fields = CONTROL_FIELDS;
    }
    if (address + count == first + fields || first == CONTROL_AT)
        write_request(modbus, pdu, length, reply);
}

// Length of the shortest request of a function, so that its numbers can be read.
static uint16_t shortest(uint8_t function)
{
    switch (function) {
    case READ_HOLDING:
    case READ_INPUT:
        return 5;
    case WRITE:
        return 6;
    case WRITE_AND_READ:
        return 10;
    default:
        return 1;
    }
}

uint16_t modbus_request(struct modbus *modbus, uint8_t unit, const uint8_t *pdu, uint16_t length,
                        uint8_t reply[MODBUS_PDU_MAX])
{
    if (unit == MODBUS_BROADCAST && length >= shortest(WRITE) && pdu[0] == WRITE)
        broadcast(modbus, pdu, length, reply);
    if (unit != modbus->unit || length == 0)
        return 0;
    if (length < shortest(pdu[0]))
        return exception(reply, pdu[0], ILLEGAL_VALUE);
    switch (pdu[0]) {
    case READ_HOLDING:
    case READ_INPUT:
        return read_request(modbus, pdu, length, reply);
    case WRITE:
        return write_request(modbus, pdu, length, reply);
    case WRITE_AND_READ:
        return write_and_read_request(modbus, pdu, length, reply);
    default:
        return exception(reply, pdu[0], ILLEGAL_FUNCTION);
    }
}
