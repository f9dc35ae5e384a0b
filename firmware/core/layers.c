// SPDX-License-Identifier: MIT
//
// Layers: what a committed set makes them play, when they end by themselves, and sets that wait for
// a moment of the clock or the end of onsets.

#include "amplifier.h"

#include <string.h>

static void let_last(struct layer *layer)
{
    timer_stop(&layer->ends);
    layer->waits = 0;
    layer->starts = layer->is_over = false;
}

static void end_by(struct amplifier *amplifier, struct layer *layer, uint16_t valid_for)
{
    timer_stop(&layer->ends);
    layer->is_over = false;
    if (valid_for > 0)
        timer_start(&layer->ends, valid_for, amplifier_now(amplifier));
}

// Samples until the onsets that a layer plays have ended.
static uint32_t onsets_left(const struct amplifier *amplifier, uint8_t layer)
{
    uint32_t last = 0;
    for (unsigned i = 0; i < CHANNELS; i++) {
        const struct voice *voice = channel_voice(&amplifier->channels[i], layer);
        if (voice == NULL || voice->path.knots == 0)
            continue;
        uint32_t left = voice_samples_left(voice, amplifier->sample);
        last = left > last ? left : last;
    }
    return last;
}

// Play the commands that follow the head of a layer.
static void start(struct amplifier *amplifier, struct layer_head head, struct reader *reader,
                  uint16_t token)
{
    bool is_named[CHANNELS_MAX] = {false};
    struct layer *layer = &amplifier->layers[head.layer];
    for (uint8_t i = 0; i < head.count; i++) {
        struct command command;
        read_command(reader, &command);
        channel_play(&amplifier->channels[command.channel], head.layer, &command, head.ramp,
                     amplifier->sample);
        is_named[command.channel] = true;
    }
    for (unsigned i = 0; i < CHANNELS; i++)
        if (!is_named[i])
            channel_play(&amplifier->channels[i], head.layer, NULL, head.ramp, amplifier->sample);
    let_last(layer);
    if (head.count == 0)
        return;
    layer->token = token;
    layer->ramp = head.ramp;
    layer->valid_for = head.valid_for;
    end_by(amplifier, layer, head.valid_for);
}

// Keep the words of a layer until the onsets have ended; its head begins at `words`.
static void wait(struct layer *layer, struct layer_head head, const uint16_t *words,
                 struct reader *reader, uint16_t token, uint32_t samples)
{
    for (uint8_t i = 0; i < head.count; i++)
        skip_command(reader);
    layer->waits = samples;
    layer->waiting_token = token;
    layer->waiting_count = (uint16_t)(reader->at - words);
    memcpy(layer->waiting, words, layer->waiting_count * sizeof *words);
}

// Let Status show the former token of a layer until the next sample comes out.
static void begin_later(struct amplifier *amplifier, uint8_t number)
{
    struct layer *layer = &amplifier->layers[number];
    bool is_playing = amplifier_layers(amplifier) >> number & 1;
    layer->former_token = is_playing ? layer->token : 0;
    layer->began = amplifier->sample;
}

// Start the committed set with the next sample, at a request or at its moment.
static void start_set(struct amplifier *amplifier, bool is_request)
{
    struct waiting_set *set = &amplifier->waiting;
    if (is_request)
        amplifier->changed = amplifier->sample;
    struct reader reader = reader_of(set->words, set->count);
    while (reader.left > 0 && reader.nak == NAK_NONE) {
        const uint16_t *words = reader.at;
        struct layer_head head = read_layer(&reader);
        struct layer *layer = &amplifier->layers[head.layer];
        uint32_t waits = head.after ? onsets_left(amplifier, head.layer) : 0;
        if (head.renew) {
            end_by(amplifier, layer, head.valid_for);
        } else if (waits > 0) {
            wait(layer, head, words, &reader, set->token, waits);
        } else {
            layer->began = 0;
            if (!is_request)
                begin_later(amplifier, head.layer);
            start(amplifier, head, &reader, set->token);
        }
    }
    set->token = 0;
}

// Whether the next sample is at or behind the moment of the set that waits.
static bool is_due(const struct amplifier *amplifier)
{
    uint32_t next = (uint32_t)(amplifier->clock >> 32);
    return amplifier->waiting.token > 0 && (int32_t)(next - amplifier->waiting.at) >= 0;
}

void amplifier_commit(struct amplifier *amplifier, uint16_t at)
{
    struct intake *intake = &amplifier->intake;
    struct waiting_set *set = &amplifier->waiting;
    uint16_t ahead = (uint16_t)(at - (amplifier_clock(amplifier) >> 16));
    if (set->token > 0) // it goes first
        start_set(amplifier, true);
    set->token = amplifier->committed = intake->token;
    set->at = (uint32_t)at << 16;
    set->count = intake->count;
    memcpy(set->words, intake->words, intake->count * sizeof *set->words);
    intake_drop(intake);
    if (ahead < 1 || ahead > AHEAD_MAX || is_due(amplifier))
        start_set(amplifier, true);
}

static void end(struct amplifier *amplifier, uint8_t number)
{
    struct layer *layer = &amplifier->layers[number];
    for (unsigned i = 0; i < CHANNELS; i++)
        channel_play(&amplifier->channels[i], number, NULL, layer->ramp, amplifier->sample);
    let_last(layer);
}

void layers_sample(struct amplifier *amplifier)
{
    for (uint8_t i = 0; i < LAYERS; i++) {
        struct layer *layer = &amplifier->layers[i];
        layer->is_over = timer_sample(&layer->ends);
        layer->starts = layer->waits > 0 && --layer->waits == 0;
    }
    if (is_due(amplifier))
        start_set(amplifier, false);
    for (uint8_t i = 0; i < LAYERS; i++) {
        struct layer *layer = &amplifier->layers[i];
        if (layer->starts) {
            struct reader reader = reader_of(layer->waiting, layer->waiting_count);
            struct layer_head head = read_layer(&reader);
            begin_later(amplifier, i);
            start(amplifier, head, &reader, layer->waiting_token);
        } else if (layer->is_over) {
            end(amplifier, i);
        }
    }
}

void layers_time(struct amplifier *amplifier)
{
    for (uint8_t i = 0; i < LAYERS; i++)
        if (timer_is_late(&amplifier->layers[i].ends, amplifier->now, amplifier->slack))
            end(amplifier, i);
}

void layers_silence(struct amplifier *amplifier, uint16_t ramp)
{
    amplifier->changed = amplifier->sample;
    amplifier->waiting.token = 0;
    for (unsigned i = 0; i < LAYERS; i++)
        let_last(&amplifier->layers[i]);
    for (unsigned i = 0; i < CHANNELS; i++)
        channel_silence(&amplifier->channels[i], ramp, amplifier->sample);
}

uint16_t amplifier_layers(const struct amplifier *amplifier)
{
    uint16_t layers = 0;
    for (unsigned i = 0; i < CHANNELS; i++)
        layers |= channel_layers(&amplifier->channels[i]);
    return layers;
}
