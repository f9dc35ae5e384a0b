// SPDX-License-Identifier: MIT
//
// An amplifier made of software: the core, rendered by the callback of a sound device.
//
// The sound thread owns the amplifiers. Requests of hosts reach it through a ring from the thread of
// the lines (lines.c) and take effect with the next block; replies return through another ring.
// Neither thread ever waits for the other.
//
// More than 16 channels are two amplifiers of half as many, at addresses 1 and 2.

#ifndef ENGINE_H
#define ENGINE_H

#include "amplifier.h"
#include "counters.h"
#include "mbap.h"
#include "ring.h"
#include "serial.h"

#define AMPLIFIERS_MAX 2
#define CONNECTIONS 4 // hosts at once
#define GAPS_MAX 64   // that can be tolerated within a second

enum law { LAW_LINEAR, LAW_SQUARE };
enum protocol { SERIAL_PROTOCOL, MODBUS_PROTOCOL };

struct sound_settings {
    uint32_t rate, channels;    // of all amplifiers
    uint32_t law, protocol;     // enum law, enum protocol
    double limit;               // largest sample, 0..1
    uint32_t max_gaps;          // within a second; more are a fault
    const char *serial_number;  // at most 30 bytes
};

struct engine {
    struct sound_settings settings;
    struct counters *counters;
    unsigned amplifiers;
    struct amplifier amplifier[AMPLIFIERS_MAX];
    char serial_numbers[AMPLIFIERS_MAX][33];
    struct serial serial[CONNECTIONS][AMPLIFIERS_MAX];
    struct modbus modbus[AMPLIFIERS_MAX];
    struct mbap mbap[CONNECTIONS];
    struct ring requests, replies;
    const struct record *answering; // the request whose replies are made
    int wake[2];                 // pipe to the thread of the lines: a reply waits
    uint32_t risen[AMPLIFIERS_MAX]; // samples of the soft start
    bool has_host;               // of the serial line
    struct record host;          // with which it came
    uint64_t gaps_at[GAPS_MAX];  // frames at the last ones
    uint32_t gap_count;
    uint32_t is_ending;          // fall silent, the stream ends
};

// Where the samples of a channel go.
struct output {
    float *samples;
    uint32_t stride;
};

// Set up; return 0, or -1 where there is no pipe. The counters are to be zero.
int engine_init(struct engine *engine, const struct sound_settings *settings,
                struct counters *counters);

// Carry out requests, then make the next frames of every channel. ahead: samples by which the first
// of them leaves the outputs later than now.
void engine_render(struct engine *engine, const struct output outputs[], uint32_t frames,
                   double ahead);

// Count a hole of so many samples in the sample clock before this block.
void engine_gap(struct engine *engine, uint32_t samples);

uint64_t engine_microseconds(void);

// The lines: a thread that carries bytes between hosts and the engine.
struct lines_settings {
    int terminal;  // descriptor of a pseudo-terminal, or -1
    int listening; // descriptor of a socket that listens, or -1
};

// Start the thread; return 0, or the number of an error.
int lines_start(struct engine *engine, const struct lines_settings *settings);

#endif
