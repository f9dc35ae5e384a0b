// SPDX-License-Identifier: MIT
//
// Modbus: functions 3, 4, 16 and 23 on the registers of the amplifier (docs/reference/
// wire-modbus.md). The same for RTU and TCP: what is between unit and checksum, the PDU.

#ifndef MODBUS_H
#define MODBUS_H

#include "amplifier.h"

#define MODBUS_PDU_MAX 253
#define MODBUS_BROADCAST 0

#define CONTROL_FIELDS 5
#define SET_FIELDS (5 + 4 * 16)
#define ENVELOPE_FIELDS (3 + 2 * ENVELOPE_KNOTS)
#define ADDRESS_FIELDS (1 + SERIAL_NUMBER_MAX / 2)

struct modbus {
    struct amplifier *amplifier;
    uint8_t unit;
    uint16_t tag; // of the last write, even if that was refused
    // What was written last, and not refused, by block.
    uint16_t control[CONTROL_FIELDS], heartbeat, set[SET_FIELDS], envelope[ENVELOPE_FIELDS];
    // Why a write was refused last.
    struct verdict refusal;
    uint16_t refused_tag;
};

void modbus_init(struct modbus *modbus, struct amplifier *amplifier, uint8_t unit);

// Carry out a request to a unit; return the length of the reply's PDU, 0 for no reply.
uint16_t modbus_request(struct modbus *modbus, uint8_t unit, const uint8_t *pdu, uint16_t length,
                        uint8_t reply[MODBUS_PDU_MAX]);

#endif
