// SPDX-License-Identifier: MIT
//
// The amplifier on a board in memory as a shared library, whose clock stands still until its caller
// moves it. One amplifier at a time; the caller brings what arrives and fetches what is sent and
// played.

#include "loop.h"
#include "mbap.h"
#include "memory.h"

#include <string.h>

#define STEP 1000 // us; between two turns of the loop

static struct mbap connection;

// buffered: samples that are made ahead.
void moved_begin(uint32_t buffered)
{
    memset(memory.lines, 0, sizeof memory.lines);
    memset(memory.addresses, 1, sizeof memory.addresses);
    connection.length = 0;
    memory.now = memory.samples_counted = 0;
    memory.samples_length = 0;
    memory.buffered = buffered;
    memory.is_interlock_open = false;
    memory.sample_time = 0;
    loop_init();
}

void moved_to(uint64_t time)
{
    while (memory.now < time) {
        memory.now = time - memory.now > STEP ? memory.now + STEP : time;
        while (!loop_once()) {
        }
    }
}

// Let time pass while the loop stands still, and the converter takes nothing where it does, too.
void moved_stall(uint64_t time, bool is_converter_still)
{
    if (is_converter_still)
        memory.samples_counted += (time - memory.now) * SAMPLE_RATE / 1000000;
    memory.now = time;
}

// Let making a sample take a time [us] from now on.
void moved_load(uint32_t sample_time)
{
    memory.sample_time = sample_time;
}

uint64_t moved_now(void)
{
    return memory.now;
}

// The samples that were made since the last call, the channels one after another; return how many.
uint32_t moved_samples(int16_t samples[SAMPLES_MAX])
{
    uint32_t length = memory.samples_length;
    memcpy(samples, memory.samples, length * sizeof samples[0]);
    memory.samples_length = 0;
    return length;
}

void moved_interlock(bool is_open)
{
    memory.is_interlock_open = is_open;
}

void moved_receive(enum line line, const uint8_t *bytes, uint32_t length)
{
    uint32_t room = RING - memory.lines[line].arrived_length;
    length = length < room ? length : room;
    memcpy(memory.lines[line].arrived + memory.lines[line].arrived_length, bytes, length);
    memory.lines[line].arrived_length += length;
    memory.lines[line].heard_at = memory.now;
    loop_once();
}

uint32_t moved_sent(enum line line, uint8_t bytes[RING])
{
    uint32_t length = memory.lines[line].sent_length;
    memcpy(bytes, memory.lines[line].sent, length);
    memory.lines[line].sent_length = 0;
    return length;
}

static void send_frame(int line, const uint8_t *frame, uint16_t length)
{
    board_write((enum line)line, frame, length);
}

// Bytes of a connection of Modbus TCP, the only one; replies are sent on LINE_MODBUS.
void moved_receive_tcp(const uint8_t *bytes, uint32_t length)
{
    loop_samples();
    mbap_take(&connection, bytes, (uint16_t)length, loop_modbus(), 1, send_frame, LINE_MODBUS);
    loop_once();
}
