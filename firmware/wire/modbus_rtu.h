// SPDX-License-Identifier: MIT
//
// Modbus RTU: frames that end with silence, guarded by a CRC-16.
//
// Give every byte to `rtu_byte`, and call `rtu_silence` again and again with the time since the last
// one. What has a good checksum when 3.5 characters of silence have passed is a request. Else its
// function says how long it is: the rest may follow after a pause of up to 20 ms, and several that
// came while nobody looked are separated. A request that follows half of another is understood.

#ifndef MODBUS_RTU_H
#define MODBUS_RTU_H

#include "modbus.h"

#define RTU_FRAME_MAX 256
#define RTU_SILENCE 1750         // us; between frames, at 19200 baud and above
#define RTU_LONGEST_PAUSE 20000  // us; within a frame

struct rtu {
    struct modbus *modbus;
    uint8_t received[RTU_FRAME_MAX];
    uint16_t length;
    uint16_t paused_at; // bytes before the last pause that may be one inside a frame
    uint32_t discarded; // frames
    uint8_t reply[RTU_FRAME_MAX];
};

void rtu_init(struct rtu *rtu, struct modbus *modbus);
void rtu_byte(struct rtu *rtu, uint8_t byte);

// Return the length of the reply to send, or 0 for none.
uint16_t rtu_silence(struct rtu *rtu, uint32_t microseconds);

#endif
