// SPDX-License-Identifier: MIT

#include "memory.h"

#include <string.h>

struct memory memory;

uint64_t board_microseconds(void)
{
    return memory.now;
}

uint32_t board_samples_due(int32_t *ahead)
{
    uint64_t passed = memory.now * SAMPLE_RATE; // in millionths of a sample
    uint64_t due = passed / 1000000 + memory.buffered - memory.samples_counted;
    *ahead = (int32_t)((1000000 - passed % 1000000) * 65536 / 1000000 + 65536 * memory.buffered);
    memory.samples_counted += due;
    return (uint32_t)due;
}

void board_output(const int16_t samples[CHANNELS])
{
    memory.now += memory.sample_time;
    if (memory.samples_length + CHANNELS > SAMPLES_MAX)
        return;
    memcpy(memory.samples + memory.samples_length, samples, CHANNELS * sizeof samples[0]);
    memory.samples_length += CHANNELS;
}

void board_wait(void)
{
}

int board_read(enum line line)
{
    if (memory.lines[line].arrived_at == memory.lines[line].arrived_length) {
        memory.lines[line].arrived_at = memory.lines[line].arrived_length = 0;
        return -1;
    }
    return memory.lines[line].arrived[memory.lines[line].arrived_at++];
}

void board_write(enum line line, const uint8_t *bytes, uint16_t length)
{
    if (length > RING - memory.lines[line].sent_length)
        return; // lost, as on a wire that nobody reads
    memcpy(memory.lines[line].sent + memory.lines[line].sent_length, bytes, length);
    memory.lines[line].sent_length += length;
}

uint32_t board_silence(enum line line)
{
    return (uint32_t)(memory.now - memory.lines[line].heard_at);
}

bool board_interlock_open(void)
{
    return memory.is_interlock_open;
}

const char *board_serial_number(void)
{
    return "FW-1";
}

uint8_t board_address(enum line line)
{
    return memory.addresses[line];
}

void board_store_address(enum line line, uint8_t address)
{
    memory.addresses[line] = address;
}
