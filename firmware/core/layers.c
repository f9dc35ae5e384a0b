// SPDX-License-Identifier: MIT
//
// Layers: what a committed set makes them play, when they end by themselves, and sets that wait for
// the end of onsets.

#include "amplifier.h"

#include <string.h>

static void let_last(struct layer *layer)
{
    timer_stop(&layer->ends);
    layer->waits = 0;
}

static void end_by(struct amplifier *amplifier, struct layer *layer, uint16_t valid_for)
{
    timer_stop(&layer->ends);
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
        uint32_t left = voice_samples_left(voice);
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
        struct command command = read_command(reader);
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
        read_command(reader);
    layer->waits = samples;
    layer->waiting_token = token;
    layer->waiting_count = (uint16_t)(reader->at - words);
    memcpy(layer->waiting, words, layer->waiting_count * sizeof *words);
}

void amplifier_play(struct amplifier *amplifier)
{
    struct intake *intake = &amplifier->intake;
    struct reader reader = reader_of(intake->words, intake->count);
    while (reader.left > 0 && reader.nak == NAK_NONE) {
        const uint16_t *words = reader.at;
        struct layer_head head = read_layer(&reader);
        struct layer *layer = &amplifier->layers[head.layer];
        uint32_t waits = head.after ? onsets_left(amplifier, head.layer) : 0;
        if (head.renew) {
            end_by(amplifier, layer, head.valid_for);
        } else if (waits > 0) {
            wait(layer, head, words, &reader, intake->token, waits);
        } else {
            start(amplifier, head, &reader, intake->token);
        }
    }
    amplifier->committed = intake->token;
    intake_drop(intake);
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
        bool has_ended = timer_sample(&layer->ends);
        if (layer->waits > 0 && --layer->waits == 0) {
            struct reader reader = reader_of(layer->waiting, layer->waiting_count);
            struct layer_head head = read_layer(&reader);
            start(amplifier, head, &reader, layer->waiting_token);
        } else if (has_ended) {
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
    for (unsigned i = 0; i < LAYERS; i++)
        let_last(&amplifier->layers[i]);
    for (unsigned i = 0; i < CHANNELS; i++)
        channel_silence(&amplifier->channels[i], ramp, amplifier->sample);
}

uint16_t amplifier_token(const struct amplifier *amplifier, uint8_t layer)
{
    for (unsigned i = 0; i < CHANNELS; i++)
        if (channel_voice(&amplifier->channels[i], layer) != NULL)
            return amplifier->layers[layer].token;
    return 0;
}
