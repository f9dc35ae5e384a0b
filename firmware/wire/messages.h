// SPDX-License-Identifier: MIT
//
// Messages, whatever carries them: the words of a request in, those of its reply out.

#ifndef MESSAGES_H
#define MESSAGES_H

#include "amplifier.h"

// Carry out a request of a type, but for Hello; the reply is written where it is not refused. None is
// to an earlier part of a set, be it kept or not: no words. reply: null of a broadcast, which most
// types may not be. What SetAddress sets, words[SET_ADDRESS_ADDRESS], is its line's to take.
struct verdict message_handle(struct amplifier *amplifier, uint8_t type, const uint16_t *words,
                              uint16_t count, struct words *reply);

// Whether there is such a message, with the features of this amplifier.
bool message_is_known(uint8_t type);

// Write the reply to a request that was refused.
void message_nak(struct words *reply, uint8_t type, struct verdict verdict);

// The texts of the identity in their order: vendor, product, serial number, firmware.
const char *message_text(const struct amplifier *amplifier, unsigned number);

// Write the identity: versions, then the four texts.
void message_identity(struct words *reply, const struct amplifier *amplifier);

#define TEXTS 4

#endif
