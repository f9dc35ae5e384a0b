// SPDX-License-Identifier: MIT
//
// Arm's MPS2 board with image AN385 (Cortex-M3, 25 MHz), as QEMU's machine mps2-an385 has it.
//
//     UART0 serial protocol, UART1 Modbus RTU, UART2 samples, UART3 CAN as slcan
//
// Bytes that arrive are taken by interrupt into a ring; those to send wait in another for the main
// loop. The SysTick only wakes it from its sleep.
//
// It has no converter: UART2 stands in for one, 16-bit little-endian integers, the channels one after
// another. It has no high voltage either; that of this file is 1800 V by definition.

#include "board.h"
#include "open.h"

#define CLOCK 25000000 // Hz

struct uart { // CMSDK APB UART
    volatile uint32_t data, state, control, interrupt, divider;
};
#define TX_FULL 1
#define RX_FULL 2
#define TX_AND_RX_ENABLED 3
#define RX_INTERRUPTS 8
#define INTERRUPTED_BY_RX 2

struct timer { // CMSDK APB timer; counts down
    volatile uint32_t control, value, reload, interrupt;
};
#define TIMER_ENABLED 1

struct systick {
    volatile uint32_t control, reload, value;
};
#define SYSTICK_INTERRUPTS 7 // enabled, interrupt, clock of the processor

#define SYSTICK ((struct systick *)0xE000E010)
#define INTERRUPTS_ENABLE (*(volatile uint32_t *)0xE000E100)

#define TIMER0 ((struct timer *)0x40000000)
#define UART0 ((struct uart *)0x40004000)
#define UART1 ((struct uart *)0x40005000)
#define UART2 ((struct uart *)0x40006000)
#define UART3 ((struct uart *)0x40007000)

#define RING_SIZE 1024 // a power of 2

struct ring {
    volatile uint32_t put, taken; // bytes, ever
    uint8_t bytes[RING_SIZE];
};

static struct line_state {
    struct uart *uart;
    uint32_t receive_interrupt; // its number
    volatile uint32_t heard_at;
} lines[] = {[LINE_SERIAL] = {.uart = UART0, .receive_interrupt = 0},
             [LINE_MODBUS] = {.uart = UART1, .receive_interrupt = 2},
             [LINE_CAN] = {.uart = UART3, .receive_interrupt = 18}};
#define LINES (sizeof lines / sizeof lines[0])

static struct ring received[LINES], sending[LINES];

static bool is_high_voltage;
static uint32_t ticks_seen;
static uint64_t half_ticks;

static uint32_t ticks(void)
{
    return UINT32_MAX - TIMER0->value;
}

static void open_uart(struct uart *uart, uint32_t baud)
{
    uart->divider = CLOCK / baud;
    uart->control = TX_AND_RX_ENABLED | RX_INTERRUPTS;
}

void board_open(void)
{
    open_uart(UART0, 921600);
    open_uart(UART1, 115200);
    open_uart(UART2, 1562500);
    open_uart(UART3, 921600);
    TIMER0->reload = UINT32_MAX;
    TIMER0->value = UINT32_MAX;
    TIMER0->control = TIMER_ENABLED;
    ticks_seen = ticks();
    SYSTICK->reload = CLOCK / 1000 - 1;
    SYSTICK->value = 0;
    SYSTICK->control = SYSTICK_INTERRUPTS;
    for (unsigned i = 0; i < LINES; i++)
        INTERRUPTS_ENABLE = UINT32_C(1) << lines[i].receive_interrupt;
}

uint32_t board_samples_due(void)
{
    uint32_t now = ticks(), elapsed = now - ticks_seen;
    ticks_seen = now;
    half_ticks += 2 * (uint64_t)elapsed; // 3125 of them are a sample
    uint32_t due = (uint32_t)(half_ticks / (2 * CLOCK / SAMPLE_RATE));
    half_ticks -= (uint64_t)due * (2 * CLOCK / SAMPLE_RATE);
    return due;
}

static void send_now(struct uart *uart, uint8_t byte)
{
    while (uart->state & TX_FULL) {
    }
    uart->data = byte;
}

void board_output(const int16_t samples[CHANNELS])
{
    for (unsigned i = 0; i < CHANNELS; i++) {
        send_now(UART2, (uint8_t)samples[i]);
        send_now(UART2, (uint8_t)((uint16_t)samples[i] >> 8));
    }
}

static void put(struct ring *ring, uint8_t byte)
{
    if (ring->put - ring->taken == RING_SIZE)
        return; // nobody takes them: lost
    ring->bytes[ring->put % RING_SIZE] = byte;
    ring->put++;
}

static int take(struct ring *ring)
{
    if (ring->put == ring->taken)
        return -1;
    uint8_t byte = ring->bytes[ring->taken % RING_SIZE];
    ring->taken++;
    return byte;
}

// The interrupt of every line, see startup.c.
void board_received(void)
{
    for (unsigned i = 0; i < LINES; i++) {
        while (lines[i].uart->state & RX_FULL) {
            lines[i].uart->interrupt = INTERRUPTED_BY_RX;
            lines[i].heard_at = ticks();
            put(&received[i], (uint8_t)lines[i].uart->data);
        }
    }
}

static bool send_some(void)
{
    bool is_sending = false;
    for (unsigned i = 0; i < LINES; i++) {
        while (sending[i].put != sending[i].taken && !(lines[i].uart->state & TX_FULL))
            lines[i].uart->data = (uint32_t)take(&sending[i]);
        is_sending = is_sending || sending[i].put != sending[i].taken;
    }
    return is_sending;
}

static bool has_received(void)
{
    for (unsigned i = 0; i < LINES; i++)
        if (received[i].put != received[i].taken)
            return true;
    return false;
}

void board_wait(void)
{
    if (send_some())
        return;
    // Masked, so that no byte comes between the look and the sleep; a masked interrupt ends it, too.
    __asm__ volatile("cpsid i");
    if (!has_received())
        __asm__ volatile("wfi");
    __asm__ volatile("cpsie i");
}

int board_read(enum line line)
{
    return take(&received[line]);
}

void board_write(enum line line, const uint8_t *bytes, uint16_t length)
{
    while (length-- > 0)
        put(&sending[line], *bytes++);
}

uint32_t board_silence(enum line line)
{
    return (ticks() - lines[line].heard_at) / (CLOCK / 1000000);
}

void board_high_voltage(bool on)
{
    is_high_voltage = on;
}

int16_t board_temperature(void)
{
    return 250;
}

uint16_t board_voltage(void)
{
    return is_high_voltage ? 1800 : 0;
}

bool board_interlock_open(void)
{
    return false; // a product reads its input here
}

enum fault board_fault(uint8_t *channel)
{
    *channel = NO_CHANNEL;
    return FAULT_NONE;
}

const char *board_serial_number(void)
{
    return "MPS2-1"; // a product reads the number of its processor
}

// A product keeps them in its flash; here they last until a reset.
static uint8_t addresses[LINES] = {1, 1, 1};

uint8_t board_address(enum line line)
{
    return addresses[line];
}

void board_store_address(enum line line, uint8_t address)
{
    addresses[line] = address;
}
