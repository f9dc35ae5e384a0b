// SPDX-License-Identifier: MIT
//
// What a board measures, of one whose outputs are numbers: 25 degrees, 1800 V, no fault.

#include "board.h"

static bool is_high_voltage;

void board_high_voltage(bool on)
{
    is_high_voltage = on;
}

struct readings board_readings(void)
{
    return (struct readings){
        .temperature = WORD_OF_TEMPERATURE(25),
        .high_voltage = is_high_voltage ? WORD_OF_HIGH_VOLTAGE(1800) : 0,
    };
}

enum fault board_fault(uint8_t *channel)
{
    *channel = NO_CHANNEL;
    return FAULT_NONE;
}
