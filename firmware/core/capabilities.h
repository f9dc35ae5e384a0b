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
struct capability capability_at(unsigned number); // from 0

// Of each channel, here the same for all: lowest and highest frequency, highest level.
#define LIMIT_COUNT 3
uint16_t channel_limit(unsigned number); // from 0

#endif
