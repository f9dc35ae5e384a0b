// SPDX-License-Identifier: MIT
//
// Modbus: function 16 writes a message into its box of registers, 3 and 4 read its reply. The same
// for RTU and TCP: what is between unit and checksum, the PDU.

#ifndef MODBUS_H
#define MODBUS_H

#include "amplifier.h"

#define MODBUS_PDU_MAX 253

// Words of the longer of the replies that are kept.
#define LONGER(a, b) ((a) > (b) ? (a) : (b))
#define MODBUS_KEPT LONGER(STATUS_WORDS(CHANNELS_MAX, LAYERS), ACHIEVED_WORDS(CHANNELS_MAX))
#define MODBUS_BOXES (MESSAGE_MARK + 1)

struct modbus {
    struct amplifier *amplifier;
    uint8_t unit, next_unit; // 0: none was set
    struct {
        uint16_t tag, result, count;
        uint16_t words[MODBUS_KEPT];
    } replies[MODBUS_BOXES];
};

void modbus_init(struct modbus *modbus, struct amplifier *amplifier, uint8_t unit);

// Carry out a request; return the length of the reply's PDU.
uint16_t modbus_request(struct modbus *modbus, const uint8_t *pdu, uint16_t length,
                        uint8_t reply[MODBUS_PDU_MAX]);

// Carry out a request to all units of a line, which has no reply.
void modbus_broadcast(struct modbus *modbus, const uint8_t *pdu, uint16_t length);

#endif
