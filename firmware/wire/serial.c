// SPDX-License-Identifier: MIT

#include "serial.h"
#include "crc.h"
#include "messages.h"

#include <string.h>

#define HEADER 5
#define TYPE 0
#define VERSION 1
#define ADDRESS 2
#define SEQUENCE 3
#define REPLY 0x80
#define BROADCAST 0
#define NEUTRAL 0 // version of what every version of the protocol has

void serial_init(struct serial *serial, struct amplifier *amplifier, uint8_t address)
{
    memset(serial, 0, sizeof *serial);
    serial->amplifier = amplifier;
    serial->address = address;
}

// Undo COBS in place: each code byte says the distance to the next zero. Return the length, or 0.
static uint16_t unstuff(uint8_t *bytes, uint16_t length)
{
    uint16_t in = 0, out = 0;
    while (in < length) {
        uint8_t code = bytes[in];
        if (in + code > length)
            return 0;
        for (uint8_t i = 1; i < code; i++)
            bytes[out++] = bytes[in + i];
        in = (uint16_t)(in + code);
        if (in < length)
            bytes[out++] = 0;
    }
    return out;
}

// A frame fits into one block of COBS: every piece between zeros has fewer than 254 bytes.
static uint16_t stuff(const uint8_t *frame, uint16_t length, uint8_t *line)
{
    uint16_t code_at = 1, out = 2;
    line[0] = 0;
    for (uint16_t i = 0; i < length; i++) {
        if (frame[i] == 0) {
            line[code_at] = (uint8_t)(out - code_at);
            code_at = out++;
        } else {
            line[out++] = frame[i];
        }
    }
    line[code_at] = (uint8_t)(out - code_at);
    line[out++] = 0;
    return out;
}

static uint16_t finish(uint8_t *frame, uint16_t length, uint8_t *line)
{
    uint32_t crc = crc32_of(frame, length);
    for (int i = 0; i < 4; i++)
        frame[length++] = (uint8_t)(crc >> 8 * i);
    return stuff(frame, length, line);
}

static uint16_t put_words(uint8_t *frame, const struct words *words)
{
    for (uint16_t i = 0; i < words->count; i++) {
        frame[HEADER + 2 * i] = (uint8_t)words->words[i];
        frame[HEADER + 2 * i + 1] = (uint8_t)(words->words[i] >> 8);
    }
    return (uint16_t)(HEADER + 2 * words->count);
}

// The reply to Hello, in bytes as in every version: versions, then texts with their lengths.
static uint16_t put_identity(uint8_t *frame, const struct amplifier *amplifier)
{
    uint16_t at = HEADER;
    frame[at++] = 1 << PROTOCOL_VERSION;
    frame[at++] = 0;
    for (unsigned i = 0; i < TEXTS; i++) {
        const char *text = message_text(amplifier, i);
        uint8_t length = (uint8_t)strlen(text);
        frame[at++] = length;
        memcpy(frame + at, text, length);
        at = (uint16_t)(at + length);
    }
    return at;
}

static bool has_good_crc(const uint8_t *frame, uint16_t length)
{
    uint32_t crc = crc32_of(frame, (uint16_t)(length - 4));
    const uint8_t *sent = frame + length - 4;
    return sent[0] == (uint8_t)crc && sent[1] == (uint8_t)(crc >> 8) &&
           sent[2] == (uint8_t)(crc >> 16) && sent[3] == (uint8_t)(crc >> 24);
}

// Carry a request out; reply: null of a broadcast. SetAddress takes effect after its reply, which has the address before it.
static struct verdict handle(struct serial *serial, const uint8_t *request, uint16_t length,
                             struct words *reply)
{
    struct verdict verdict = {.nak = NAK_UNSUPPORTED_VERSION, .channel = NO_CHANNEL};
    uint16_t words[WORDS_MAX], count = (uint16_t)((length - HEADER) / 2);
    if (request[VERSION] != PROTOCOL_VERSION)
        return verdict;
    verdict.nak = message_is_known(request[TYPE]) ? NAK_BAD_LENGTH : NAK_UNKNOWN_TYPE;
    for (uint16_t i = 0; i < count; i++)
        words[i] = (uint16_t)(request[HEADER + 2 * i] | request[HEADER + 2 * i + 1] << 8);
    if ((length - HEADER) % 2 != 0) {
        if (request[TYPE] == MESSAGE_SET && count > SET_BITS && is_earlier_part(words[SET_BITS]))
            verdict.nak = NAK_NONE; // dropped without a word
        return verdict;
    }
    verdict = message_handle(serial->amplifier, request[TYPE], words, count, reply);
    if (request[TYPE] == MESSAGE_SET_ADDRESS && verdict.nak == NAK_NONE)
        serial->address = (uint8_t)words[SET_ADDRESS_ADDRESS];
    return verdict;
}

static uint16_t frame_received(struct serial *serial)
{
    uint8_t *request = serial->received, frame[SERIAL_FRAME_MAX];
    uint16_t length = unstuff(request, serial->received_length);
    bool is_for_us = request[ADDRESS] == serial->address || request[ADDRESS] == BROADCAST;
    struct words reply = {.count = 0};
    if (length < HEADER + 4 || length > SERIAL_FRAME_MAX || !has_good_crc(request, length) ||
        (request[TYPE] & REPLY) != 0 || request[TYPE] == MESSAGE_EVENT || !is_for_us) {
        serial->discarded++;
        return 0;
    }
    length = (uint16_t)(length - 4);
    memcpy(frame, request, HEADER); // address and sequence are those of the request
    if (request[ADDRESS] == BROADCAST) {
        handle(serial, request, length, NULL);
        return 0;
    }
    frame[TYPE] = request[TYPE] | REPLY;
    if (request[TYPE] == MESSAGE_HELLO) {
        frame[VERSION] = NEUTRAL;
        return finish(frame, put_identity(frame, serial->amplifier), serial->reply);
    }
    struct verdict verdict = handle(serial, request, length, &reply);
    if (verdict.nak != NAK_NONE) {
        message_nak(&reply, request[TYPE], verdict);
        frame[TYPE] = MESSAGE_NAK | REPLY;
    } else if (reply.count == 0) {
        return 0;
    }
    if (verdict.nak == NAK_UNSUPPORTED_VERSION)
        frame[VERSION] = NEUTRAL;
    return finish(frame, put_words(frame, &reply), serial->reply);
}

uint16_t serial_byte(struct serial *serial, uint8_t byte)
{
    if (byte != 0) {
        if (serial->received_length == SERIAL_STUFFED_MAX)
            serial->is_overlong = true;
        else
            serial->received[serial->received_length++] = byte;
        return 0;
    }
    uint16_t reply = 0;
    if (serial->is_overlong)
        serial->discarded++;
    else if (serial->received_length > 0)
        reply = frame_received(serial);
    serial->received_length = 0;
    serial->is_overlong = false;
    return reply;
}

uint16_t serial_event(struct serial *serial, const struct wire_event *event,
                      uint8_t line[SERIAL_STUFFED_MAX + 2])
{
    uint8_t frame[SERIAL_FRAME_MAX] = {
        [TYPE] = MESSAGE_EVENT, [VERSION] = PROTOCOL_VERSION, [ADDRESS] = serial->address};
    struct words words = {.count = 0};
    if (SERIAL_IS_SHARED)
        return 0;
    serial->events++;
    frame[SEQUENCE] = (uint8_t)serial->events;
    frame[SEQUENCE + 1] = (uint8_t)(serial->events >> 8);
    put_event(&words, event);
    return finish(frame, put_words(frame, &words), line);
}
