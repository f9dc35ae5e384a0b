// SPDX-License-Identifier: MIT
//
// The registers: blocks, each of a tag and its fields. Blocks that are written are requests.

#ifndef MODBUS_REGISTERS_H
#define MODBUS_REGISTERS_H

#include "modbus.h"

// Registers from the tag of a block to its first field.
#define TAG_BEFORE 1

// First fields of the blocks.
#define CONTROL_AT 2
#define HEARTBEAT_AT 10
#define LOOK_AT 12 // a tag alone
#define SET_AT 16
#define ENVELOPE_AT 102
#define ADDRESS_AT 182 // written by broadcast alone
#define STATUS_AT 1002
#define REFUSAL_AT 1034
#define CAPABILITIES_AT 1352
#define IDENTITY_AT 1066
#define ACHIEVED_AT 1142
#define FAULTS_AT 1222
#define REGISTERS_END 2000 // from here on they are the vendor's own: none

// The value of a register; undefined ones are 0.
uint16_t modbus_read(const struct modbus *modbus, uint16_t address);

// Carry out a write of the fields of a block, whole, from its first field on.
struct verdict modbus_write(struct modbus *modbus, uint16_t first_field, const uint16_t *fields,
                            uint16_t count);

#endif
