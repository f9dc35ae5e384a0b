// SPDX-License-Identifier: MIT
//
// The amplifier in a time of its own, for comparisons sample by sample: a script on the serial line
// says at which sample which bytes arrive. Each line of it is a sample number and hexadecimal
// digits, as in
//
//     1600 000C020107000905 41BE716600
//
// Replies go to the serial line. After a line without digits, samples up to its number have been
// made.

#include "amplifier.h"
#include "board.h"
#include "replay.h"
#include "serial.h"

static struct amplifier amplifier;
static struct serial serial;

static char next_character(void)
{
    int byte = board_read(LINE_SERIAL);
    while (byte < 0) {
        board_wait();
        byte = board_read(LINE_SERIAL);
    }
    return (char)byte;
}

static void advance_to(uint64_t sample)
{
    int16_t samples[CHANNELS];
    while (amplifier.now < sample) {
        amplifier_sample(&amplifier, samples);
        board_output(samples);
    }
}

static void receive(uint8_t byte)
{
    uint16_t length = serial_byte(&serial, byte);
    if (length > 0)
        board_write(LINE_SERIAL, serial.reply, length);
}

static int digit(char character)
{
    if (character >= '0' && character <= '9')
        return character - '0';
    if (character >= 'A' && character <= 'F')
        return character - 'A' + 10;
    return -1;
}

static void replay_line(void)
{
    uint64_t sample = 0;
    int high = -1;
    char character = next_character();
    for (; digit(character) >= 0; character = next_character())
        sample = sample * 10 + (uint64_t)digit(character);
    advance_to(sample);
    for (; character != '\n'; character = next_character()) {
        int low = digit(character);
        if (low >= 0 && high >= 0) {
            receive((uint8_t)(high << 4 | low));
            high = -1;
        } else if (low >= 0) {
            high = low;
        }
    }
}

void replay(void)
{
    amplifier_init(&amplifier, board_serial_number());
    serial_init(&serial, &amplifier, board_address(LINE_SERIAL));
    for (;;)
        replay_line();
}
