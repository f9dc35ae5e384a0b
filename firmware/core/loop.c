// SPDX-License-Identifier: MIT

#include "loop.h"
#include "amplifier.h"
#include "board.h"
#include "serial.h"

static struct amplifier amplifier;
static struct serial serial;
static uint32_t samples_to_measuring;

void loop_init(void)
{
    amplifier_init(&amplifier, board_serial_number());
    serial_init(&serial, &amplifier, board_address());
    board_high_voltage(false);
}

static void measure(void)
{
    uint8_t channel = NO_CHANNEL;
    enum fault cause = board_fault(&channel);
    amplifier_measured(&amplifier, board_temperature(), board_voltage(), cause, channel);
}

static void make_samples(void)
{
    int16_t samples[CHANNELS];
    for (uint32_t due = board_samples_due(); due > 0; due--) {
        if (samples_to_measuring-- == 0) { // every millisecond
            samples_to_measuring = SAMPLES_PER_MS - 1;
            measure();
        }
        amplifier_sample(&amplifier, samples);
        board_output(samples);
        board_high_voltage(amplifier.high_voltage);
    }
}

static void read_serial(void)
{
    for (int byte = board_read(LINE_SERIAL); byte >= 0; byte = board_read(LINE_SERIAL)) {
        uint16_t length = serial_byte(&serial, (uint8_t)byte);
        board_high_voltage(amplifier.high_voltage);
        if (length > 0) {
            measure();
            board_write(LINE_SERIAL, serial.reply, length);
        }
    }
}

void loop_once(void)
{
    make_samples();
    read_serial();
}
