// SPDX-License-Identifier: MIT

#include "serial.h"
#include "crc.h"
#include "serial_messages.h"

#include <string.h>

#define HEADER 5
#define TYPE 0
#define VERSION 1
#define ADDRESS 2
#define BROADCAST 0

void serial_init(struct serial *serial, struct amplifier *amplifier, uint8_t address)
{
    memset(serial, 0, sizeof *serial);
    serial->amplifier = amplifier;
    serial->address = address;
}

// Undo COBS in place: each code byte tells the distance to the next zero. Return the length, or 0.
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

static bool has_good_crc(const uint8_t *frame, uint16_t length)
{
    uint32_t crc = crc32_of(frame, (uint16_t)(length - 4));
    const uint8_t *sent = frame + length - 4;
    return sent[0] == (uint8_t)crc && sent[1] == (uint8_t)(crc >> 8) &&
           sent[2] == (uint8_t)(crc >> 16) && sent[3] == (uint8_t)(crc >> 24);
}

static uint16_t frame_received(struct serial *serial)
{
    uint8_t *request = serial->received;
    uint16_t length = unstuff(request, serial->received_length);
    bool is_for_us = request[ADDRESS] == serial->address || request[ADDRESS] == BROADCAST;
    if (length < HEADER + 4 || !has_good_crc(request, length) || (request[TYPE] & REPLY) != 0 ||
        !is_for_us) {
        serial->discarded++;
        return 0;
    }
    uint8_t frame[SERIAL_FRAME_MAX];
    memcpy(frame, request, HEADER); // address and sequence are those of the request
    struct reader payload = {request + HEADER, (uint16_t)(length - HEADER - 4), false};
    struct writer reply = {frame, HEADER, SERIAL_FRAME_MAX - 4, false};
    if (request[ADDRESS] == BROADCAST) {
        serial_broadcast(serial->amplifier, &serial->address, request[TYPE], request[VERSION],
                         &payload);
        return 0;
    }
    struct header header = serial_answer(serial->amplifier, &serial->address, request[TYPE],
                                         request[VERSION], &payload, &reply);
    if (header.type == 0)
        return 0;
    frame[TYPE] = header.type;
    frame[VERSION] = header.version;
    uint32_t crc = crc32_of(frame, reply.length);
    reply.size = SERIAL_FRAME_MAX;
    write_u32(&reply, crc);
    return stuff(frame, reply.length, serial->reply);
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
