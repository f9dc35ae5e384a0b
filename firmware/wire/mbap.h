// SPDX-License-Identifier: MIT
//
// Frames of Modbus TCP: transaction u16, protocol u16 (0), length u16 of what follows, unit u8, PDU.

#ifndef MBAP_H
#define MBAP_H

#include "modbus.h"

#define MBAP_HEADER 7
#define MBAP_FRAME_MAX (MBAP_HEADER + MODBUS_PDU_MAX)

// A connection: what has arrived, and was not carried out.
struct mbap {
    uint8_t received[MBAP_FRAME_MAX];
    uint16_t length;
    uint64_t heard_at; // us; when the last bytes came
};

typedef void mbap_send(int to, const uint8_t *frame, uint16_t length);

// Take bytes, and carry out the frames that they complete, for several units; send the replies `to`
// the connection. What is no frame is discarded with all that came with it, and what has
// begun after a pause.
void mbap_take(struct mbap *mbap, const uint8_t *bytes, uint16_t length, struct modbus units[],
               unsigned count, mbap_send *send, int to);

#endif
