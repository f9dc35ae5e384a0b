// SPDX-License-Identifier: MIT
//
// Messages of the serial line: payloads of requests read and carried out, payloads of replies
// written.

#ifndef SERIAL_MESSAGES_H
#define SERIAL_MESSAGES_H

#include "amplifier.h"
#include "bytes.h"

#define REPLY 0x80 // bit of the type

struct header {
    uint8_t type, version;
};

// Carry out a request and append the payload of its reply; return type and version of the reply.
struct header serial_answer(struct amplifier *amplifier, uint8_t type, uint8_t version,
                            struct reader *payload, struct writer *reply);

// Carry out a Commit or Stop to every amplifier; ignore anything else.
void serial_broadcast(struct amplifier *amplifier, uint8_t type, uint8_t version,
                      struct reader *payload);

#endif
