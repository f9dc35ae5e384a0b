// SPDX-License-Identifier: MIT
//
// A board in memory, whose clock stands still until its caller moves it: the amplifier as a shared
// library. One amplifier at a time; the caller brings what arrives and fetches what is sent and
// played.

#include "board.h"
#include "loop.h"
#include "mbap.h"

#include <string.h>

#define LINES 3
#define RING 8192 // bytes
#define STEP 1000 // us; between two turns of the loop
#define SAMPLES_MAX (1 << 21)

static struct {
    uint8_t arrived[RING], sent[RING];
    uint32_t arrived_length, arrived_at, sent_length;
    uint64_t heard_at;
} lines[LINES];
static struct mbap connection;
static uint64_t now, samples_counted; // us, and those made of them
static int16_t samples_made[SAMPLES_MAX];
static uint32_t samples_length; // of all channels, not fetched yet
static bool is_interlock_open;
static uint8_t addresses[LINES];

void moved_begin(void)
{
    memset(lines, 0, sizeof lines);
    memset(addresses, 1, sizeof addresses);
    connection.length = 0;
    now = samples_counted = 0;
    samples_length = 0;
    is_interlock_open = false;
    loop_init();
}

void moved_to(uint64_t time)
{
    while (now < time) {
        now = time - now > STEP ? now + STEP : time;
        loop_once();
    }
}

// Let time pass while the loop stands still, and the converter takes nothing where it does, too.
void moved_stall(uint64_t time, bool is_converter_still)
{
    if (is_converter_still)
        samples_counted += (time - now) * SAMPLE_RATE / 1000000;
    now = time;
}

// The samples that were made since the last call, the channels one after another; return how many.
uint32_t moved_samples(int16_t samples[SAMPLES_MAX])
{
    uint32_t length = samples_length;
    memcpy(samples, samples_made, length * sizeof samples[0]);
    samples_length = 0;
    return length;
}

void moved_interlock(bool is_open)
{
    is_interlock_open = is_open;
}

void moved_receive(enum line line, const uint8_t *bytes, uint32_t length)
{
    uint32_t room = RING - lines[line].arrived_length;
    length = length < room ? length : room;
    memcpy(lines[line].arrived + lines[line].arrived_length, bytes, length);
    lines[line].arrived_length += length;
    lines[line].heard_at = now;
    loop_once();
}

uint32_t moved_sent(enum line line, uint8_t bytes[RING])
{
    uint32_t length = lines[line].sent_length;
    memcpy(bytes, lines[line].sent, length);
    lines[line].sent_length = 0;
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

uint64_t board_microseconds(void)
{
    return now;
}

uint32_t board_samples_due(void)
{
    uint64_t due = now * SAMPLE_RATE / 1000000 - samples_counted;
    samples_counted += due;
    return (uint32_t)due;
}

void board_output(const int16_t samples[CHANNELS])
{
    if (samples_length + CHANNELS > SAMPLES_MAX)
        return;
    memcpy(samples_made + samples_length, samples, CHANNELS * sizeof samples[0]);
    samples_length += CHANNELS;
}

void board_wait(void)
{
}

int board_read(enum line line)
{
    if (lines[line].arrived_at == lines[line].arrived_length) {
        lines[line].arrived_at = lines[line].arrived_length = 0;
        return -1;
    }
    return lines[line].arrived[lines[line].arrived_at++];
}

void board_write(enum line line, const uint8_t *bytes, uint16_t length)
{
    if (length > RING - lines[line].sent_length)
        return; // lost, as on a wire that nobody reads
    memcpy(lines[line].sent + lines[line].sent_length, bytes, length);
    lines[line].sent_length += length;
}

uint32_t board_silence(enum line line)
{
    return (uint32_t)(now - lines[line].heard_at);
}

bool board_interlock_open(void)
{
    return is_interlock_open;
}

const char *board_serial_number(void)
{
    return "FW-1";
}

uint8_t board_address(enum line line)
{
    return addresses[line];
}

void board_store_address(enum line line, uint8_t address)
{
    addresses[line] = address;
}
