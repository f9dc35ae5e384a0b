// SPDX-License-Identifier: MIT

#include "transfer.h"

#include <string.h>

#define LOST 0xf   // paInputUnderflow, paInputOverflow, paOutputUnderflow, paOutputOverflow
#define CONTINUE 0 // paContinue

// Frames of this block that are to be moved; 0 while nothing runs.
static uint32_t wanted(const struct transfer *transfer, uint32_t frames)
{
    if (!GET(transfer->is_running))
        return 0;
    uint64_t left = transfer->frames - transfer->position;
    return left < frames ? (uint32_t)left : frames;
}

static void done(struct transfer *transfer, uint32_t frames)
{
    if (transfer->arrivals != NULL)
        transfer->arrivals[transfer->blocks] = engine_microseconds();
    transfer->blocks++;
    uint64_t position = transfer->position + frames;
    if (position == transfer->frames)
        SET(transfer->is_running, 0);
    SET(transfer->position, position);
}

int transfer_jack_process(uint32_t frames, void *given)
{
    struct transfer *transfer = given;
    const struct transfer_ports *ports = transfer->ports;
    uint32_t count = wanted(transfer, frames);
    uint32_t frame = ports->frame_time(ports->client);
    if (count && transfer->has_next && frame != transfer->next_frame && transfer->position)
        COUNT(transfer->gaps, 1);
    transfer->next_frame = frame + frames;
    transfer->has_next = 1;
    for (uint32_t i = 0; i < transfer->outputs; i++) {
        float *to = ports->buffer(ports->outputs[i], frames);
        memset(to, 0, frames * sizeof(float));
        const float *from = transfer->play + transfer->position * transfer->outputs + i;
        for (uint32_t n = 0; n < count; n++)
            to[n] = from[(uint64_t)n * transfer->outputs];
    }
    for (uint32_t i = 0; count && i < transfer->inputs; i++) {
        const float *from = ports->buffer(ports->inputs[i], frames);
        float *to = transfer->record + transfer->position * transfer->inputs + i;
        for (uint32_t n = 0; n < count; n++)
            to[(uint64_t)n * transfer->inputs] = from[n];
    }
    if (count)
        done(transfer, count);
    return 0;
}

void transfer_jack_shutdown(void *given)
{
    struct transfer *transfer = given;
    SET(transfer->is_lost, 1);
}

int transfer_portaudio(const void *input, void *output, unsigned long frames,
                       const struct portaudio_time *time, unsigned long flags, void *given)
{
    (void)time;
    struct transfer *transfer = given;
    uint32_t count = wanted(transfer, (uint32_t)frames);
    if (count && (flags & LOST) && transfer->position)
        COUNT(transfer->gaps, 1);
    if (output != NULL) {
        size_t frame = transfer->outputs * sizeof(float);
        memset(output, 0, frames * frame);
        if (count)
            memcpy(output, transfer->play + transfer->position * transfer->outputs, count * frame);
    }
    if (count && input != NULL)
        memcpy(transfer->record + transfer->position * transfer->inputs, input,
               count * transfer->inputs * sizeof(float));
    if (count)
        done(transfer, count);
    return CONTINUE;
}
