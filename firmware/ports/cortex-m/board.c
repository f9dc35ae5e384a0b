// SPDX-License-Identifier: MIT
//
// The board: Arm's MPS2 with the image AN385 (Cortex-M3, 25 MHz), which QEMU emulates.
//
// UART 0 is the serial line, UART 1 Modbus RTU, UART 2 CAN as text (lines.c). Timer 0 is the clock of
// the converter, the board's microsecond counter real time; timer 1 wakes the loop. LED 0 is the high
// voltage, button 0 the interlock. The board has no converter: samples end in a buffer, from which a
// DMA channel would take them.

#include "board.h"
#include "lines.h"
#include "mps2.h"
#include "cortex_m.h"

#include <string.h>

// Samples are made ahead of the converter, to bridge a tick and the longest request: every set starts
// later by as much.
#ifndef SAMPLES_AHEAD
#define SAMPLES_AHEAD (SAMPLES_PER_MS / 2)
#endif
#define TICK 125 // us; longest sleep
#ifndef STALL_MAX
#define STALL_MAX WATCHDOG_MIN // ms; longest pass of the main loop
#endif
#define MAGIC UINT32_C(0x45524131)

static volatile bool has_ticked;
static bool is_high_voltage;
static int16_t converter[SAMPLES_AHEAD + 1][CHANNELS];
static unsigned converter_at;

// Survives a reset, but not a power cycle: use flash in a product.
__attribute__((section(".kept"))) static struct {
    uint32_t magic;
    uint8_t addresses[LINES];
} kept;

// Time and samples.

uint64_t board_microseconds(void)
{
    static uint64_t now;
    now += (uint32_t)(FPGA->counter - (uint32_t)now); // read more often than the counter wraps
    return now;
}

uint32_t board_samples_due(int32_t *ahead)
{
    static uint32_t last = UINT32_MAX;
    static uint64_t passed = (uint64_t)SAMPLES_AHEAD * CLOCK_RATE; // in 1 / CLOCK_RATE of a sample
    uint32_t value = CONVERTER_TIMER->value;                       // counts down
    passed += (uint64_t)(uint32_t)(last - value) * SAMPLE_RATE;
    last = value;
    uint32_t due = (uint32_t)(passed / CLOCK_RATE);
    passed %= CLOCK_RATE;
    *ahead = (int32_t)((CLOCK_RATE - passed) * 65536 / CLOCK_RATE) + SAMPLES_AHEAD * 65536;
    return due;
}

void board_output(const int16_t samples[CHANNELS_MAX])
{
    memcpy(converter[converter_at], samples, sizeof converter[0]);
    converter_at = (converter_at + 1) % (SAMPLES_AHEAD + 1);
}

void tick(void)
{
    TICK_TIMER->interrupts = 1;
    has_ticked = true;
}

void board_wait(void)
{
    disable_interrupts(); // an interrupt after the test still ends the sleep
    if (!has_ticked && lines_are_empty())
        wait_for_interrupt();
    has_ticked = false;
    enable_interrupts();
}

void board_feed_watchdog(void)
{
    WATCHDOG->clear = 1;
}

// Lines.

static const uint32_t rates[LINES] = {
    [LINE_SERIAL] = 921600,
    [LINE_MODBUS] = 115200, // with even parity, if the UART has it
    [LINE_CAN] = 115200,
};

int board_read(enum line line)
{
    return line_read(line);
}

void board_write(enum line line, const uint8_t *bytes, uint16_t length)
{
    line_write(line, bytes, length);
}

uint32_t board_silence(enum line line)
{
    return line_silence(line);
}

// High voltage and measured values.

void board_high_voltage(bool on)
{
    is_high_voltage = on;
    FPGA->leds = on;
}

void board_shut_down(void)
{
    FPGA->leds = 0;
    memset(converter, 0, sizeof converter);
}

struct readings board_readings(void)
{
    return (struct readings){
        .temperature = WORD_OF_TEMPERATURE(25),
        .high_voltage = is_high_voltage ? WORD_OF_HIGH_VOLTAGE(1800) : 0,
    };
}

bool board_interlock_open(void)
{
    return FPGA->buttons & 1;
}

enum fault board_fault(uint8_t *channel)
{
    *channel = NO_CHANNEL;
    return FAULT_NONE;
}

// Identity.

const char *board_serial_number(void)
{
    return "MPS2-1";
}

uint8_t board_address(enum line line)
{
    return kept.addresses[line];
}

void board_store_address(enum line line, uint8_t address)
{
    kept.addresses[line] = address;
}

void board_open(void)
{
    if (kept.magic != MAGIC) {
        kept.magic = MAGIC;
        memset(kept.addresses, 1, sizeof kept.addresses);
    }
    FPGA->prescale = CYCLES_PER_US - 1;
    FPGA->counter = 0;
    CONVERTER_TIMER->reload = CONVERTER_TIMER->value = UINT32_MAX;
    CONVERTER_TIMER->control = TIMER_ENABLE;
    TICK_TIMER->reload = TICK_TIMER->value = TICK * CYCLES_PER_US;
    TICK_TIMER->control = TIMER_ENABLE | TIMER_INTERRUPT;
    lines_open(rates);
    INTERRUPTS_ENABLE = UART_INTERRUPTS | TICK_INTERRUPT;
    WATCHDOG->reload = STALL_MAX * 1000 * CYCLES_PER_US;
    WATCHDOG->control = WATCHDOG_ENABLE;
}
