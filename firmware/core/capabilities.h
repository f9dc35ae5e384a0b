// SPDX-License-Identifier: MIT
//
// What GetCaps reports, in the order of the pages: one list for every wire.

#ifndef CAPABILITIES_H
#define CAPABILITIES_H

#include "config.h"

struct capability {
    uint16_t value;
    uint8_t size; // bytes on the serial line and on CAN; always one Modbus register
};

#define CAPABILITY_COUNT 14
extern const struct capability CAPABILITIES[CAPABILITY_COUNT];

#endif
