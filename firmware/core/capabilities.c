// SPDX-License-Identifier: MIT

#include "capabilities.h"

struct capability capability_at(unsigned number)
{
    const struct capability capabilities[CAPABILITY_COUNT] = {
        {CHANNELS, 1},
        {FREQUENCY_MIN, 2},
        {FREQUENCY_MAX, 2},
        {1, 2}, // frequency step
        {LEVEL_MAX, 2},
        {1, 2}, // level step
        {1, 2}, // phase step
        {RAMP_MAX, 2},
        {WATCHDOG_MIN, 2},
        {WATCHDOG_MAX, 2},
        {ENVELOPE_KNOTS, 1},
        {ENVELOPE_SLOTS, 1},
        {ENVELOPE_STEP_MIN, 2},
        {ENVELOPE_STEP_MAX, 2},
        {FEATURES, 2},
        {VOICES, 1},
    };
    return capabilities[number];
}

uint16_t channel_limit(unsigned number)
{
    const uint16_t limits[LIMIT_COUNT] = {FREQUENCY_MIN, FREQUENCY_MAX, LEVEL_MAX};
    return limits[number];
}
