// SPDX-License-Identifier: MIT

#include "modbus_rtu.h"
#include "crc.h"

#include <string.h>

#define CRC_SIZE 2
#define BROADCAST 0
#define WRITE 16   // the function whose length varies
#define COUNT_AT 6 // of its byte that says how many follow

void rtu_init(struct rtu *rtu, struct modbus *modbus)
{
    memset(rtu, 0, sizeof *rtu);
    rtu->modbus = modbus;
}

void rtu_byte(struct rtu *rtu, uint8_t byte)
{
    if (rtu->length < RTU_FRAME_MAX)
        rtu->received[rtu->length++] = byte;
}

// Length of the request that begins here, 0 if that is not known yet.
static uint16_t expected_length(const uint8_t *frame, uint16_t length)
{
    if (length < 2)
        return 0;
    if (frame[1] != WRITE)
        return 6 + CRC_SIZE;
    return length > COUNT_AT ? (uint16_t)(COUNT_AT + 1 + frame[COUNT_AT] + CRC_SIZE) : 0;
}

static bool has_good_crc(const uint8_t *frame, uint16_t length)
{
    if (length < 2 + CRC_SIZE)
        return false;
    uint16_t crc = crc16_of(frame, (uint16_t)(length - CRC_SIZE));
    return frame[length - 2] == (uint8_t)crc && frame[length - 1] == (uint8_t)(crc >> 8);
}

static uint16_t request_received(struct rtu *rtu, uint16_t length)
{
    const uint8_t *pdu = rtu->received + 1;
    uint16_t pdu_length = (uint16_t)(length - 1 - CRC_SIZE);
    if (rtu->received[0] == BROADCAST)
        modbus_broadcast(rtu->modbus, pdu, pdu_length);
    if (rtu->received[0] != rtu->modbus->unit)
        return 0;
    rtu->reply[0] = rtu->received[0];
    uint16_t size = modbus_request(rtu->modbus, pdu, pdu_length, rtu->reply + 1);
    uint16_t crc = crc16_of(rtu->reply, (uint16_t)(size + 1));
    rtu->reply[size + 1] = (uint8_t)crc;
    rtu->reply[size + 2] = (uint8_t)(crc >> 8);
    return (uint16_t)(size + 1 + CRC_SIZE);
}

// Forget the first bytes.
static void drop(struct rtu *rtu, uint16_t count)
{
    rtu->length = (uint16_t)(rtu->length - count);
    memmove(rtu->received, rtu->received + count, rtu->length);
    rtu->paused_at = 0;
}

// Length of the request at the beginning of what has arrived; 0: none, or not yet.
static uint16_t first_request(struct rtu *rtu)
{
    if (has_good_crc(rtu->received, rtu->length))
        return rtu->length;
    if (has_good_crc(rtu->received + rtu->paused_at, (uint16_t)(rtu->length - rtu->paused_at))) {
        rtu->discarded++; // half a frame before it
        drop(rtu, rtu->paused_at);
        return rtu->length;
    }
    uint16_t length = expected_length(rtu->received, rtu->length);
    bool is_whole = length > 0 && length <= rtu->length;
    return is_whole && has_good_crc(rtu->received, length) ? length : 0;
}

// Whether the rest of a frame may follow.
static bool may_go_on(const struct rtu *rtu)
{
    uint16_t length = expected_length(rtu->received, rtu->length);
    return rtu->length < RTU_FRAME_MAX && length <= RTU_FRAME_MAX &&
           (length == 0 || length > rtu->length);
}

uint16_t rtu_silence(struct rtu *rtu, uint32_t microseconds)
{
    if (rtu->length == 0 || microseconds < RTU_SILENCE)
        return 0;
    uint16_t length = first_request(rtu);
    if (length > 0) {
        uint16_t reply = request_received(rtu, length);
        drop(rtu, length);
        return reply;
    }
    if (may_go_on(rtu) && microseconds < RTU_LONGEST_PAUSE) {
        rtu->paused_at = rtu->length;
    } else {
        rtu->discarded++;
        drop(rtu, rtu->length);
    }
    return 0;
}
