// SPDX-License-Identifier: MIT

#include "mbap.h"

#include <string.h>

#define PAUSE_MAX 1000000 // us; within a frame

static void answer(const uint8_t *frame, uint16_t size, struct modbus *modbus, mbap_send *send,
                   int to)
{
    uint8_t reply[MBAP_FRAME_MAX];
    if (frame[6] != modbus->unit)
        return;
    uint16_t length = modbus_request(modbus, frame + MBAP_HEADER, (uint16_t)(size - MBAP_HEADER),
                                     reply + MBAP_HEADER);
    memcpy(reply, frame, MBAP_HEADER); // transaction, protocol and unit are the request's
    reply[4] = (uint8_t)((length + 1) >> 8);
    reply[5] = (uint8_t)(length + 1);
    send(to, reply, (uint16_t)(MBAP_HEADER + length));
}

// Size of the frame that has begun; 0: it is none.
static uint16_t size_of(const struct mbap *mbap)
{
    uint16_t following = (uint16_t)(mbap->received[4] << 8 | mbap->received[5]);
    bool is_frame = mbap->received[2] == 0 && mbap->received[3] == 0 && following >= 2 &&
                    following <= MODBUS_PDU_MAX + 1;
    return is_frame ? (uint16_t)(6 + following) : 0;
}

void mbap_take(struct mbap *mbap, const uint8_t *bytes, uint16_t length, struct modbus units[],
               unsigned count, mbap_send *send, int to)
{
    uint64_t now = units[0].amplifier->now;
    if (now - mbap->heard_at > PAUSE_MAX)
        mbap->length = 0;
    mbap->heard_at = now;
    while (length > 0) {
        mbap->received[mbap->length++] = *bytes++;
        length--;
        if (mbap->length < MBAP_HEADER)
            continue;
        uint16_t size = size_of(mbap);
        if (size == 0) {
            mbap->length = 0;
            return;
        }
        if (mbap->length < size)
            continue;
        mbap->length = 0;
        for (unsigned i = 0; i < count; i++)
            answer(mbap->received, size, &units[i], send, to);
    }
}
