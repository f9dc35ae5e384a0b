// SPDX-License-Identifier: MIT

#include "loop.h"
#include "amplifier.h"
#include "board.h"
#include "modbus_rtu.h"
#include "serial.h"
#include "slcan.h"

#include <string.h>

static struct amplifier amplifier;
static struct serial serial;
static struct modbus modbus;
static struct rtu rtu;
static struct can_node node;
static struct slcan slcan;
static uint32_t samples_to_measuring;
static uint8_t stored[3]; // addresses, of each line
static bool is_high_voltage;

static uint32_t overdue; // samples that are due and not made yet

#define OVERDUE_MAX (LATE_MAX * SAMPLES_PER_MS)
#define TURN (LATE_MAX * 1000 / 4) // us; longest time between two looks for bytes

static void send_can(const struct can_frame *frame)
{
    char line[SLCAN_LINE_MAX];
    uint16_t length = slcan_format(frame, line);
    if (slcan.is_open)
        board_write(LINE_CAN, (const uint8_t *)line, length);
}

static void notify(const struct amplifier *changed, const struct wire_event *event)
{
    uint8_t line[SERIAL_STUFFED_MAX + 2];
    (void)changed;
    uint16_t length = serial_event(&serial, event, line);
    if (length > 0)
        board_write(LINE_SERIAL, line, length);
    can_event(&node, event);
}

void loop_init(void)
{
    for (int line = LINE_SERIAL; line <= LINE_CAN; line++)
        stored[line] = board_address((enum line)line);
    amplifier_init(&amplifier, board_serial_number(), notify);
    amplifier_time(&amplifier, board_microseconds());
    serial_init(&serial, &amplifier, stored[LINE_SERIAL]);
    modbus_init(&modbus, &amplifier, stored[LINE_MODBUS]);
    rtu_init(&rtu, &modbus);
    can_init(&node, &amplifier, stored[LINE_CAN], send_can);
    slcan_init(&slcan, &node);
    board_high_voltage(is_high_voltage = false);
}

static void measure(void)
{
    struct measured measured = {
        .readings = board_readings(),
        .is_interlock_open = board_interlock_open(),
    };
    measured.cause = board_fault(&measured.channel);
    amplifier_measured(&amplifier, measured);
}

// Switched, it is measured at once: no status shows the voltage of before beside the new state.
static void switch_high_voltage(void)
{
    bool is_switched = is_high_voltage != amplifier.high_voltage;
    board_high_voltage(is_high_voltage = amplifier.high_voltage);
    if (is_switched)
        measure();
}

// Overload: leave out the samples that are late, and fall silent.
static void give_up(uint64_t now)
{
    amplifier_skip(&amplifier, overdue);
    overdue = 0;
    amplifier_time(&amplifier, now); // an expired watchdog is the fault in its place
    amplifier_overload(&amplifier);
}

static void make_sample(void)
{
    int16_t samples[CHANNELS_MAX];
    if (samples_to_measuring-- == 0) { // every millisecond
        samples_to_measuring = SAMPLES_PER_MS - 1;
        measure();
    }
    amplifier_sample(&amplifier, samples);
    board_output(samples);
    overdue--;
}

// By how much the next sample comes out later than now: without overdue samples this is `ahead`.
static int32_t ahead_of_overdue(int32_t ahead)
{
    int64_t left = ahead - (int64_t)overdue * 65536;
    return left > 0 ? (int32_t)left : 0;
}

void loop_samples(void)
{
    int32_t ahead;
    uint64_t now = board_microseconds();
    overdue += board_samples_due(&ahead);
    if (overdue > OVERDUE_MAX)
        give_up(now);
    amplifier.heard = 0;
    uint64_t span = (uint64_t)overdue * 1000000 / SAMPLE_RATE;
    amplifier_time(&amplifier, now > span ? now - span : 0); // of the first one
    while (overdue > 0 && board_microseconds() - now < TURN)
        make_sample();
    amplifier.ahead = ahead_of_overdue(ahead);
    amplifier_time(&amplifier, now);
    switch_high_voltage();
}

// Make the samples that are due by the last byte of a frame; return the silence since it [us].
static uint32_t hear(enum line line)
{
    uint32_t silence = board_silence(line);
    loop_samples();
    amplifier.heard = silence;
    return silence;
}

static void send(enum line line, const uint8_t *reply, uint16_t length)
{
    switch_high_voltage();
    if (length > 0)
        board_write(line, reply, length);
}

// Keep an address that a host has set; its reply is on the way.
static void store(enum line line, uint8_t address)
{
    if (stored[line] == address)
        return;
    stored[line] = address;
    board_store_address(line, address);
}

static void serve_serial(void)
{
    for (int byte = board_read(LINE_SERIAL); byte >= 0; byte = board_read(LINE_SERIAL)) {
        if (byte == 0) // the end of a frame
            hear(LINE_SERIAL);
        send(LINE_SERIAL, serial.reply, serial_byte(&serial, (uint8_t)byte));
    }
}

static void serve_modbus(void)
{
    for (int byte = board_read(LINE_MODBUS); byte >= 0; byte = board_read(LINE_MODBUS))
        rtu_byte(&rtu, (uint8_t)byte);
    if (rtu.length > 0)
        send(LINE_MODBUS, rtu.reply, rtu_silence(&rtu, hear(LINE_MODBUS)));
}

static void serve_can(void)
{
    for (int byte = board_read(LINE_CAN); byte >= 0; byte = board_read(LINE_CAN)) {
        if (byte == '\r')
            hear(LINE_CAN);
        const char *answer = slcan_byte(&slcan, (uint8_t)byte);
        if (answer != NULL)
            send(LINE_CAN, (const uint8_t *)answer, (uint16_t)strlen(answer));
    }
    can_time(&node);
}

struct modbus *loop_modbus(void)
{
    return &modbus;
}

bool loop_once(void)
{
    loop_samples();
    serve_serial();
    serve_modbus();
    serve_can();
    store(LINE_SERIAL, serial.address);
    store(LINE_MODBUS, modbus.unit);
    store(LINE_CAN, node.number);
    return overdue == 0;
}
