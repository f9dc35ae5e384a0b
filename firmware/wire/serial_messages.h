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
// Type 0: it is for another amplifier of this address, and there is no reply. SetAddress changes the
// address.
struct header serial_answer(struct amplifier *amplifier, uint8_t *address, uint8_t type,
                            uint8_t version, struct reader *payload, struct writer *reply);

// Carry out a Commit, Stop or SetAddress to every amplifier; ignore anything else.
void serial_broadcast(struct amplifier *amplifier, uint8_t *address, uint8_t type, uint8_t version,
                      struct reader *payload);

#endif
