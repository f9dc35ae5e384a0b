// SPDX-License-Identifier: MIT
//
// The serial line: frames between zeros, stuffed with COBS and guarded by a CRC-32.
//
// Give every byte that arrives to `serial_byte`. When it completes a request, the request has been
// carried out and its reply, delimiters and all, is in `reply`.

#ifndef SERIAL_H
#define SERIAL_H

#include "amplifier.h"

#define SERIAL_PAYLOAD_MAX 240
#define SERIAL_FRAME_MAX (5 + SERIAL_PAYLOAD_MAX + 4)
#define SERIAL_STUFFED_MAX (SERIAL_FRAME_MAX + 1)

struct serial {
    struct amplifier *amplifier;
    uint8_t address;
    uint8_t received[SERIAL_STUFFED_MAX];
    uint16_t received_length;
    bool is_overlong;
    uint32_t discarded; // frames
    uint8_t reply[SERIAL_STUFFED_MAX + 2];
};

void serial_init(struct serial *serial, struct amplifier *amplifier, uint8_t address);

// Take a byte; return the length of the reply, or 0 for none.
uint16_t serial_byte(struct serial *serial, uint8_t byte);

#endif
