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
#define SLACK 2          // blocks by which samples may come later than their time
#define REQUESTS_MAX 16  // pieces carried out before a block, so that its work is bounded
#define ENDING_RAMP 5    // ms

static struct engine *notifying; // the engine of this process

uint64_t engine_microseconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000 + (uint64_t)now.tv_nsec / 1000;
}

static void notify(const struct amplifier *amplifier, const struct wire_event *event);

int engine_init(struct engine *engine, const struct sound_settings *settings,
                struct counters *counters)
{
    memset(engine, 0, sizeof *engine);
    notifying = engine;
    engine->settings = *settings;
    engine->counters = counters;
    engine->amplifiers = settings->channels > CHANNELS_MAX ? 2 : 1;
    sound_format.rate = settings->rate;
    sound_format.channels = (uint8_t)(settings->channels / engine->amplifiers);
    sound_format.is_shared = engine->amplifiers > 1;
    double highest = settings->law == LAW_SQUARE ? 2 * settings->limit * settings->limit - 1
                                                 : settings->limit;
    sound_format.level_max = (uint16_t)lround(highest * LEVEL_PER_UNIT);
    if (pipe(engine->wake) < 0 || fcntl(engine->wake[0], F_SETFL, O_NONBLOCK) < 0 ||
        fcntl(engine->wake[1], F_SETFL, O_NONBLOCK) < 0)
        return -1;
    for (unsigned i = 0; i < engine->amplifiers; i++) {
        char *name = engine->serial_numbers[i];
        snprintf(name, sizeof engine->serial_numbers[i], i == 0 ? "%.30s" : "%.30s-2",
                 settings->serial_number);
        amplifier_init(&engine->amplifier[i], name, notify);
        amplifier_time(&engine->amplifier[i], engine_microseconds());
        modbus_init(&engine->modbus[i], &engine->amplifier[i], (uint8_t)(i + 1));
    }
    engine->settings.serial_number = NULL;
    return 0;
}

// Requests and replies.

static bool reply(struct engine *engine, const struct record *request, const uint8_t *bytes,
                  uint16_t length)
{
    struct record *record = ring_free(&engine->replies);
    if (record == NULL) // a host that does not read loses replies
        return false;
    record->connection = request->connection;
    record->generation = request->generation;
    record->length = length;
    memcpy(record->bytes, bytes, length);
    ring_push(&engine->replies);
    return true;
}

static void wake(struct engine *engine)
{
    if (write(engine->wake[1], "", 1) < 0)
        return; // the pipe is full: the thread of the lines has enough to wake up for
}

// Send an Event to the host of the serial line.
static void notify(const struct amplifier *amplifier, const struct wire_event *event)
{
    uint8_t line[SERIAL_STUFFED_MAX + 2];
    (void)amplifier;
    uint16_t length =
        notifying->has_host
            ? serial_event(&notifying->serial[notifying->host.connection][0], event, line)
            : 0;
    if (length > 0 && reply(notifying, &notifying->host, line, length))
        wake(notifying);
}

static bool serve_serial(struct engine *engine, const struct record *request)
{
    struct serial *serial = engine->serial[request->connection];
    bool has_replied = false;
    if (request->length == 0) {
        engine->host = *request;
        engine->has_host = true;
    }
    for (unsigned i = 0; i < engine->amplifiers && request->length == 0; i++) // a new host
        serial_init(&serial[i], &engine->amplifier[i], (uint8_t)(i + 1));
    for (uint16_t at = 0; at < request->length; at++)
        for (unsigned i = 0; i < engine->amplifiers; i++) {
            uint16_t length = serial_byte(&serial[i], request->bytes[at]);
            if (length > 0)
                has_replied |= reply(engine, request, serial[i].reply, length);
        }
    return has_replied;
}

static void send_frame(int connection, const uint8_t *frame, uint16_t length)
{
    (void)connection;
    reply(notifying, notifying->answering, frame, length);
}

static bool serve_modbus(struct engine *engine, const struct record *request)
{
    struct mbap *mbap = &engine->mbap[request->connection];
    if (request->length == 0) // a new host
        mbap->length = 0;
    engine->answering = request;
    mbap_take(mbap, request->bytes, request->length, engine->modbus, engine->amplifiers, send_frame,
              request->connection);
    return true;
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
    if (has_replied)
        wake(engine);
}

// Time and faults.

void engine_gap(struct engine *engine, uint32_t samples)
{
    for (unsigned i = 0; i < engine->amplifiers; i++)
        amplifier_skip(&engine->amplifier[i], samples);
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

// Say what time it is; samples may come later than that by what the device asks for at once.
static void keep_time(struct engine *engine, uint32_t frames, double ahead)
{
    uint64_t now = engine_microseconds();
    for (unsigned i = 0; i < engine->amplifiers; i++) {
        engine->amplifier[i].ahead = (int32_t)(65536 * fmax(-32767, fmin(ahead, 32767)));
        engine->amplifier[i].slack = (uint32_t)(SLACK * UINT64_C(1000000) * frames / SAMPLE_RATE);
        amplifier_time(&engine->amplifier[i], now);
    }
}

static void measure(struct engine *engine)
{
    bool is_faulty = has_too_many_gaps(engine);
    for (unsigned i = 0; i < engine->amplifiers; i++) {
        struct measured measured = {
            .cause = is_faulty ? FAULT_INTERNAL : FAULT_NONE, .channel = NO_CHANNEL};
        amplifier_measured(&engine->amplifier[i], measured);
        if (GET(engine->is_ending) && engine->amplifier[i].state == OPERATION_ENABLED)
            amplifier_stop(&engine->amplifier[i], ENDING_RAMP);
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

void engine_render(struct engine *engine, const struct output outputs[], uint32_t frames,
                   double ahead)
{
    int32_t forces[CHANNELS_MAX];
    SET(engine->counters->block, frames);
    keep_time(engine, frames, ahead);
    serve(engine);
    measure(engine);
    for (uint32_t frame = 0; frame < frames; frame++)
        for (unsigned i = 0; i < engine->amplifiers; i++) {
            double gain = soft_start(engine, i);
            amplifier_forces(&engine->amplifier[i], forces);
            for (unsigned channel = 0; channel < CHANNELS; channel++) {
                const struct output *output = &outputs[i * CHANNELS + channel];
                output->samples[frame * output->stride] = sample(engine, forces[channel], gain);
            }
        }
    COUNT(engine->counters->frames, frames);
    COUNT(engine->counters->blocks, 1);
}
