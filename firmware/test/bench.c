// SPDX-License-Identifier: MIT
//
// How many instructions a sample and a frame take: run by QEMU with `-icount shift=0`, where every
// instruction takes one nanosecond, so that the 25 MHz timer counts one tick for each 40 of them.
// Prints lines `what: instructions` to UART0.

#include "amplifier.h"
#include "board.h"
#include "modbus_rtu.h"
#include "open.h"
#include "serial.h"

#include <string.h>

#define TIMER0_VALUE (*(volatile uint32_t *)0x40000004)
#define INSTRUCTIONS_PER_TICK 40
#define REPETITIONS 1000

static struct amplifier amplifier;
static struct serial serial;

static void print(const char *text)
{
    board_write(LINE_SERIAL, (const uint8_t *)text, (uint16_t)strlen(text));
}

static void report(const char *what, uint32_t instructions)
{
    char digits[12], *at = digits + sizeof digits - 1;
    *at = 0;
    do {
        *--at = (char)('0' + instructions % 10);
        instructions /= 10;
    } while (instructions > 0);
    print(what);
    print(": ");
    print(at);
    print("\n");
    for (int i = 0; i < 100; i++)
        board_wait(); // until it is sent
}

static void measure_samples(const char *what)
{
    int16_t samples[CHANNELS];
    uint32_t from = TIMER0_VALUE;
    for (int i = 0; i < REPETITIONS; i++)
        amplifier_sample(&amplifier, samples);
    report(what, (from - TIMER0_VALUE) * INSTRUCTIONS_PER_TICK / REPETITIONS);
}

static void measure_frame(const char *what, const uint8_t *frame, uint16_t length)
{
    uint16_t reply = 0;
    uint32_t from = TIMER0_VALUE;
    for (uint16_t i = 0; i < length; i++)
        reply = serial_byte(&serial, frame[i]);
    uint32_t ticks = from - TIMER0_VALUE;
    report(reply > 0 ? what : "no reply", ticks * INSTRUCTIONS_PER_TICK);
}

static void play(uint16_t token, uint16_t frequency, uint16_t ramp, uint8_t onset)
{
    struct set set = {.token = token, .ramp = ramp};
    for (uint8_t i = 0; i < CHANNELS; i++) {
        struct command command = {.channel = i, .frequency = frequency, .level = 5000};
        command.onset = onset;
        set_add(&set, &command);
    }
    amplifier_apply(&amplifier, 9, &set);
}

int main(void)
{
    // Of the page: a Ping, and an Apply of two channels with token 513.
    static const uint8_t PING[] = {0x00, 0x05, 0x0C, 0x02, 0x01, 0x07, 0x02, 0x09, 0x05,
                                   0x41, 0xBE, 0x71, 0x66, 0x00};
    static const uint8_t APPLY[] = {0x00, 0x05, 0x07, 0x02, 0x01, 0x07, 0x02, 0x09, 0x04, 0x01,
                                    0x02, 0x14, 0x04, 0xF4, 0x01, 0x02, 0x01, 0x05, 0x98, 0x08,
                                    0xD0, 0x07, 0x01, 0x0D, 0x03, 0x01, 0x92, 0x13, 0x10, 0x27,
                                    0xD8, 0xDC, 0xA3, 0x44, 0xBB, 0xF8, 0x00};
    struct envelope envelope = {.step = 1000, .knots = 32};
    board_open();
    amplifier_init(&amplifier, board_serial_number());
    serial_init(&serial, &amplifier, 1);
    measure_samples("sample, disarmed");
    amplifier_arm(&amplifier, WATCHDOG_MAX, 9);
    measure_samples("sample, armed and silent");
    amplifier_load(&amplifier, 1, &envelope);
    play(1, 2000, 0, 0);
    measure_samples("sample, 4 channels steady");
    play(2, 3000, 1000, 0);
    measure_samples("sample, 4 channels in a cross-fade");
    amplifier_stop(&amplifier, 0);
    amplifier_clear(&amplifier, amplifier.latch);
    amplifier_arm(&amplifier, WATCHDOG_MAX, 10);
    amplifier_stop(&amplifier, 0);
    amplifier_clear(&amplifier, amplifier.latch);
    amplifier_arm(&amplifier, WATCHDOG_MAX, 9);
    play(1, 2000, 0, 0);
    play(2, 3000, 1000, 1);
    measure_samples("sample, 4 channels in an onset over a fade");
    amplifier.active.token = 0;
    amplifier_ping(&amplifier, 9);
    measure_frame("Ping and its reply", PING, sizeof PING);
    for (unsigned i = 0; i < CHANNELS; i++)
        channel_quiet(&amplifier.channels[i], 0);
    measure_frame("Apply of 2 channels and its reply", APPLY, sizeof APPLY);
    print("end\n");
    for (;;)
        board_wait();
}
