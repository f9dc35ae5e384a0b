// SPDX-License-Identifier: MIT
//
// The serial line: frames between zeros, stuffed with COBS and guarded by a CRC-32.
//
// Give every byte that arrives to `serial_byte`. When it completes a request, the request has been
// carried out and its reply, delimiters and all, is in `reply`.

#ifndef SERIAL_H
#define SERIAL_H

#include "amplifier.h"

#define SERIAL_FRAME_MAX (5 + 2 * WORDS_MAX + 4)
#define SERIAL_STUFFED_MAX (SERIAL_FRAME_MAX + 1)

struct serial {
    struct amplifier *amplifier;
    uint8_t address;
    uint8_t received[SERIAL_STUFFED_MAX];
    uint16_t received_length;
    bool is_overlong;
    uint32_t discarded; // frames
    uint16_t events;    // sent
    uint8_t reply[SERIAL_STUFFED_MAX + 2];
};

void serial_init(struct serial *serial, struct amplifier *amplifier, uint8_t address);

// Take a byte; return the length of the reply, or 0 for none.
uint16_t serial_byte(struct serial *serial, uint8_t byte);

// Write an Event as a frame, where no other amplifier is on the line; return its length.
uint16_t serial_event(struct serial *serial, const struct wire_event *event,
                      uint8_t line[SERIAL_STUFFED_MAX + 2]);

#endif
