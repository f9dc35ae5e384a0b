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

#define CAPABILITY_COUNT 16
#define FEATURES_SUB 15 // where FEATURES is in this list, from 1
extern const struct capability CAPABILITIES[CAPABILITY_COUNT];

// Of each channel, here the same for all: lowest and highest frequency, highest level.
#define LIMIT_COUNT 3
extern const uint16_t CHANNEL_LIMITS[LIMIT_COUNT];

#endif
