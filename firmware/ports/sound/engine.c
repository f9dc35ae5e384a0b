// SPDX-License-Identifier: MIT

#define _XOPEN_SOURCE 700

#include "engine.h"
#include "sine.h"

#include <fcntl.h>
#include <math.h>
#include <stdio.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#define SOFT_START 10    // ms
#define LATE_MAX 50      // ms that count against watchdogs, of one time without samples
#define SLACK 2          // blocks by which samples may come later than their time
#define REQUESTS_MAX 16  // pieces carried out before a block, so that its work is bounded
#define HEADER 7         // of Modbus TCP
#define ANY_UNIT 255
#define ENDING_RAMP 5    // ms

struct sound_format sound_format;

uint64_t engine_microseconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000 + (uint64_t)now.tv_nsec / 1000;
}

int engine_init(struct engine *engine, const struct sound_settings *settings,
                struct counters *counters)
{
    memset(engine, 0, sizeof *engine);
    engine->settings = *settings;
    engine->counters = counters;
    engine->amplifiers = settings->channels > CHANNELS_MAX ? 2 : 1;
    sound_format.rate = settings->rate;
    sound_format.channels = (uint8_t)(settings->channels / engine->amplifiers);
    double most = settings->law == LAW_SQUARE ? 2 * settings->limit * settings->limit - 1
                                              : settings->limit;
    sound_format.level_max = (uint16_t)lround(most * FULL_STROKE);
    if (pipe(engine->wake) < 0 || fcntl(engine->wake[0], F_SETFL, O_NONBLOCK) < 0 ||
        fcntl(engine->wake[1], F_SETFL, O_NONBLOCK) < 0)
        return -1;
    for (unsigned i = 0; i < engine->amplifiers; i++) {
        char *name = engine->serial_numbers[i];
        snprintf(name, sizeof engine->serial_numbers[i], i == 0 ? "%.30s" : "%.30s-2",
                 settings->serial_number);
        amplifier_init(&engine->amplifier[i], name);
        modbus_init(&engine->modbus[i], &engine->amplifier[i], (uint8_t)(i + 1));
        if (settings->is_recovering)
            amplifier_fail(&engine->amplifier[i], FAULT_INTERNAL, NO_CHANNEL);
    }
    engine->settings.serial_number = NULL;
    return 0;
}

// Requests and replies.

static bool reply(struct engine *engine, const struct record *request, const uint8_t *head,
                  uint16_t head_length, const uint8_t *bytes, uint16_t length)
{
    struct record *record = ring_free(&engine->replies);
    if (record == NULL) // a host that does not read loses replies
        return false;
    record->connection = request->connection;
    record->generation = request->generation;
    record->length = (uint16_t)(head_length + length);
    if (head_length > 0)
        memcpy(record->bytes, head, head_length);
    memcpy(record->bytes + head_length, bytes, length);
    ring_push(&engine->replies);
    return true;
}

static bool serve_serial(struct engine *engine, const struct record *request)
{
    struct serial *serial = engine->serial[request->connection];
    bool has_replied = false;
    for (unsigned i = 0; i < engine->amplifiers && request->length == 0; i++) // a new host
        serial_init(&serial[i], &engine->amplifier[i], (uint8_t)(i + 1));
    for (uint16_t at = 0; at < request->length; at++)
        for (unsigned i = 0; i < engine->amplifiers; i++) {
            uint16_t length = serial_byte(&serial[i], request->bytes[at]);
            if (length > 0)
                has_replied |= reply(engine, request, NULL, 0, serial[i].reply, length);
        }
    return has_replied;
}

// A whole frame of Modbus TCP: transaction u16, protocol u16, length u16, unit u8, PDU.
static bool serve_modbus(struct engine *engine, const struct record *request)
{
    if (request->length < HEADER)
        return false;
    bool has_replied = false;
    uint8_t unit = request->bytes[6] == ANY_UNIT ? 1 : request->bytes[6];
    for (unsigned i = 0; i < engine->amplifiers; i++) {
        uint8_t pdu[MODBUS_PDU_MAX], head[HEADER];
        uint16_t length = modbus_request(&engine->modbus[i], unit, request->bytes + HEADER,
                                         (uint16_t)(request->length - HEADER), pdu);
        if (length == 0)
            continue;
        memcpy(head, request->bytes, HEADER);
        head[4] = (uint8_t)((length + 1) >> 8);
        head[5] = (uint8_t)(length + 1);
        has_replied |= reply(engine, request, head, HEADER, pdu, length);
    }
    return has_replied;
}

static void serve(struct engine *engine)
{
    bool has_replied = false;
    for (unsigned i = 0; i < REQUESTS_MAX; i++) {
        const struct record *request = ring_first(&engine->requests);
        if (request == NULL)
            break;
        has_replied |= engine->settings.protocol == MODBUS_PROTOCOL
                           ? serve_modbus(engine, request)
                           : serve_serial(engine, request);
        COUNT(engine->counters->requests, 1);
        ring_pop(&engine->requests);
    }
    if (has_replied && write(engine->wake[1], "", 1) < 0)
        return; // the pipe is full: the thread of the lines has enough to wake up for
}

// Time and faults.

void engine_gap(struct engine *engine)
{
    COUNT(engine->counters->gaps, 1);
    engine->gaps_at[engine->gap_count++ % GAPS_MAX] = engine->counters->frames;
}

static bool has_too_many_gaps(const struct engine *engine)
{
    uint32_t most = engine->settings.max_gaps;
    if (engine->gap_count <= most)
        return false;
    uint64_t then = engine->gaps_at[(engine->gap_count - 1 - most) % GAPS_MAX];
    return engine->counters->frames - then < engine->settings.rate;
}

// The earlier of the sample clock and of time: samples that come late shorten what waits.
static void keep_time(struct engine *engine, uint32_t frames)
{
    uint64_t now = engine_microseconds();
    double rate = engine->settings.rate, slack = SLACK * (double)frames;
    double passed = engine->rendered_at == 0
                        ? frames
                        : (double)(now - engine->rendered_at) * rate / 1e6;
    engine->rendered_at = now;
    engine->clock_ahead += passed - frames;
    if (engine->clock_ahead < -slack)
        engine->clock_ahead = -slack;
    if (engine->clock_ahead <= slack)
        return;
    double late = engine->clock_ahead - slack, most = LATE_MAX * rate / 1000;
    engine->clock_ahead = slack;
    for (unsigned i = 0; i < engine->amplifiers; i++)
        amplifier_late(&engine->amplifier[i], (uint32_t)(late < most ? late : most));
}

static void measure(struct engine *engine)
{
    bool is_faulty = GET(engine->counters->is_lost) || !engine->has_stream ||
                     has_too_many_gaps(engine);
    for (unsigned i = 0; i < engine->amplifiers; i++) {
        struct measured measured = {0, 0, false, is_faulty ? FAULT_INTERNAL : FAULT_NONE,
                                    NO_CHANNEL};
        amplifier_measured(&engine->amplifier[i], measured);
        if (GET(engine->is_ending) && engine->amplifier[i].state == OPERATION_ENABLED)
            amplifier_stop(&engine->amplifier[i], ENDING_RAMP);
        SET(engine->counters->state[i], (uint32_t)engine->amplifier[i].state);
        SET(engine->counters->fault[i], (uint32_t)engine->amplifier[i].fault);
    }
}

// Samples.

// From 0 to 1 along a raised cosine once the high voltage is on, and back.
static double soft_start(struct engine *engine, unsigned number)
{
    uint32_t all = SOFT_START * SAMPLES_PER_MS;
    uint32_t *risen = &engine->risen[number];
    if (engine->amplifier[number].high_voltage)
        *risen += *risen < all;
    else
        *risen -= *risen > 0;
    if (*risen == all)
        return 1;
    return (double)raised_cosine((uint32_t)(((uint64_t)*risen << 32) / all)) / ONE;
}

static float sample(struct engine *engine, int32_t force, double gain)
{
    double value = (double)force / ONE;
    if (engine->settings.law == LAW_SQUARE)
        value = sqrt((1 + value) / 2);
    value *= gain;
    double limit = engine->settings.limit;
    if (value > limit || value < -limit) {
        COUNT(engine->counters->clipped, 1);
        value = value > 0 ? limit : -limit;
    }
    return (float)value;
}

void engine_render(struct engine *engine, const struct output outputs[], uint32_t frames)
{
    int32_t forces[CHANNELS_MAX];
    SET(engine->counters->block, frames);
    keep_time(engine, frames);
    serve(engine);
    measure(engine);
    for (uint32_t frame = 0; frame < frames; frame++)
        for (unsigned i = 0; i < engine->amplifiers; i++) {
            double gain = soft_start(engine, i);
            amplifier_forces(&engine->amplifier[i], forces);
            for (unsigned channel = 0; channel < CHANNELS && outputs != NULL; channel++) {
                const struct output *output = &outputs[i * CHANNELS + channel];
                output->samples[frame * output->stride] = sample(engine, forces[channel], gain);
            }
        }
    COUNT(engine->counters->frames, frames);
    COUNT(engine->counters->blocks, 1);
}
