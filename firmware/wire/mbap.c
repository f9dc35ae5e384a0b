// SPDX-License-Identifier: MIT

#include "mbap.h"

#include <string.h>

#define ANY_UNIT 255

static void answer(const struct mbap *mbap, struct modbus *modbus, uint16_t size, mbap_send *send,
                   int to)
{
    uint8_t reply[MBAP_FRAME_MAX];
    uint8_t unit = mbap->received[6] == ANY_UNIT ? modbus->unit : mbap->received[6];
    uint16_t length = modbus_request(modbus, unit, mbap->received + MBAP_HEADER,
                                     (uint16_t)(size - MBAP_HEADER), reply + MBAP_HEADER);
    if (length == 0)
        return;
    memcpy(reply, mbap->received, MBAP_HEADER); // transaction, protocol and unit are the request's
    reply[4] = (uint8_t)((length + 1) >> 8);
    reply[5] = (uint8_t)(length + 1);
    send(to, reply, (uint16_t)(MBAP_HEADER + length));
}

void mbap_take(struct mbap *mbap, struct modbus *modbus, mbap_send *send, int to)
{
    while (mbap->length >= MBAP_HEADER) {
        uint16_t following = (uint16_t)(mbap->received[4] << 8 | mbap->received[5]);
        bool is_frame = mbap->received[2] == 0 && mbap->received[3] == 0 && following >= 2 &&
                        following <= MODBUS_PDU_MAX + 1;
        uint16_t size = (uint16_t)(6 + following);
        if (!is_frame) {
            mbap->length = 0;
            return;
        }
        if (mbap->length < size)
            return;
        answer(mbap, modbus, size, send, to);
        mbap->length = (uint16_t)(mbap->length - size);
        memmove(mbap->received, mbap->received + size, mbap->length);
    }
}
