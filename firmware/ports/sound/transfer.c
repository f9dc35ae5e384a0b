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
    uint64_t position = transfer->position + frames;
    if (position == transfer->frames)
        SET(transfer->is_running, 0);
    SET(transfer->position, position);
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
