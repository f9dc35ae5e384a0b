// SPDX-License-Identifier: MIT
//
// What an amplifier sends, made by docs/generators/firmware_records.py: do not edit it. Each record
// of protocol 4 is a struct, and a function that appends its words; RECORD_WORDS is their number
// with so many of what varies. A field that is not filled in is sent as 0. Readings, which a board
// takes, are a struct of their own.

#ifndef RECORDS_H
#define RECORDS_H

#include "words.h"

struct wire_limit {
    uint16_t frequency_min, frequency_max, level_max;
};
static inline void put_limit(struct words *words, const struct wire_limit *from)
{
    PUT(words, from->frequency_min, from->frequency_max, from->level_max);
}

struct wire_capabilities {
    uint16_t channels, layers, voices, set_words, knots, features, frequency_min, frequency_max,
        frequency_step, level_max, level_step, phase_step, ramp_max, slew, watchdog_min,
        watchdog_max, envelope_step_min, envelope_step_max, clock_error;
    const struct wire_limit *limits;
};
#define CAPABILITIES_WORDS(channels) (19 + 3 * (channels))
static inline void put_capabilities(struct words *words, const struct wire_capabilities *from)
{
    PUT(words, from->channels, from->layers, from->voices, from->set_words, from->knots,
        from->features, from->frequency_min, from->frequency_max, from->frequency_step,
        from->level_max, from->level_step, from->phase_step, from->ramp_max, from->slew,
        from->watchdog_min, from->watchdog_max, from->envelope_step_min, from->envelope_step_max,
        from->clock_error);
    for (unsigned i = 0; i < from->channels; i++)
        put_limit(words, &from->limits[i]);
}

struct readings {
    int16_t temperature; // 0.1 °C, of the amplifier
    uint16_t high_voltage; // 1 V, of the supply; 0: not measured
};
// Of a value in its unit, as WORD_OF_TEMPERATURE(25) of 25 degrees.
#define WORD_OF_TEMPERATURE(value) ((value) * 10)
#define WORD_OF_HIGH_VOLTAGE(value) ((value) * 1)

struct wire_status {
    uint16_t state, fault, flags, latch, watchdog_left;
    uint32_t clock;
    uint16_t token;
    uint8_t channels, layers;
    const uint16_t *levels;
    const uint16_t *tokens;
    struct readings readings;
};
#define STATUS_WORDS(channels, layers) (11 + (channels) + (layers))
static inline void put_status(struct words *words, const struct wire_status *from)
{
    PUT(words, from->state, from->fault, from->flags, from->latch, from->watchdog_left,
        (uint16_t)from->readings.temperature, from->readings.high_voltage, (uint16_t)(from->clock
        >> 16), (uint16_t)from->clock, from->token, (uint16_t)(from->channels << 8 |
        from->layers));
    put_all(words, from->levels, from->channels);
    put_all(words, from->tokens, from->layers);
}

struct wire_taken {
    uint16_t token;
    bool exact, staged, played;
    uint16_t missing;
};
static inline void put_taken(struct words *words, const struct wire_taken *from)
{
    PUT(words, from->token, (uint16_t)(from->exact << 2 | from->staged << 1 | from->played),
        from->missing);
}

struct wire_fault {
    uint16_t fault, channel;
    uint32_t age;
};
static inline void put_fault(struct words *words, const struct wire_fault *from)
{
    PUT(words, from->fault, from->channel, (uint16_t)(from->age >> 16), (uint16_t)from->age);
}

struct wire_faults {
    uint16_t count;
    const struct wire_fault *faults;
};
#define FAULTS_WORDS(count) (1 + 4 * (count))
static inline void put_faults(struct words *words, const struct wire_faults *from)
{
    PUT(words, from->count);
    for (unsigned i = 0; i < from->count; i++)
        put_fault(words, &from->faults[i]);
}

struct wire_command {
    uint8_t channel;
    bool keep_phase, skip_ending, onset, ending;
    uint16_t frequency, level;
    int16_t phase;
};
static inline void put_command(struct words *words, const struct wire_command *from)
{
    PUT(words, (uint16_t)(from->channel << 4 | from->keep_phase << 3 | from->skip_ending << 2 |
        from->onset << 1 | from->ending), from->frequency, from->level, (uint16_t)from->phase);
}

struct wire_achieved {
    uint16_t token;
    uint8_t layer;
    bool after, renew;
    uint8_t count;
    uint16_t ramp, valid_for;
    const struct wire_command *commands;
};
#define ACHIEVED_WORDS(count) (4 + 4 * (count))
static inline void put_achieved(struct words *words, const struct wire_achieved *from)
{
    PUT(words, from->token, (uint16_t)(from->layer << 7 | from->after << 6 | from->renew << 5 |
        from->count), from->ramp, from->valid_for);
    for (unsigned i = 0; i < from->count; i++)
        put_command(words, &from->commands[i]);
}

struct wire_event {
    uint16_t state, fault, channel, latch;
};
static inline void put_event(struct words *words, const struct wire_event *from)
{
    PUT(words, from->state, from->fault, from->channel, from->latch);
}

struct wire_nak {
    uint16_t request, code, channel;
};
static inline void put_nak(struct words *words, const struct wire_nak *from)
{
    PUT(words, from->request, from->code, from->channel);
}

#endif
