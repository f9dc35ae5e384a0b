// SPDX-License-Identifier: MIT

#include "lines.h"
#include "mps2.h"

// The interrupt writes `put`, the main loop `taken`. Everything is volatile, so that the compiler
// writes a byte before the index that publishes it.
struct receive_ring {
    volatile uint8_t bytes[RING];
    volatile uint32_t stamps[RING]; // us; arrival of each byte
    volatile uint16_t put, taken;
};

// The main loop writes `put`, the interrupt `taken`.
struct send_ring {
    volatile uint8_t bytes[RING];
    volatile uint16_t put, taken;
};

static struct receive_ring received[LINES];
static struct send_ring sending[LINES];
static uint32_t read_stamps[LINES]; // of the byte that was read last
struct line_counters line_counters[LINES];

static uint16_t next(uint16_t index)
{
    return (uint16_t)((index + 1) % RING);
}

static uint16_t used(uint16_t put, uint16_t taken)
{
    return (uint16_t)((put - taken) % RING);
}

static void receive(unsigned line)
{
    struct receive_ring *ring = &received[line];
    struct line_counters *counters = &line_counters[line];
    struct uart_registers *uart = UART(line);
    uart->interrupts = UART_CLEAR_RECEIVED;
    if (uart->state & UART_OVERRUN) {
        uart->state = UART_OVERRUN;
        counters->bytes_lost++;
    }
    while (uart->state & UART_RECEIVED) {
        uint8_t byte = (uint8_t)uart->data;
        uint16_t put = ring->put, following = next(put);
        if (following == ring->taken) { // full: the frame is damaged
            counters->bytes_lost++;
            continue;
        }
        ring->bytes[put] = byte;
        ring->stamps[put] = FPGA->counter;
        ring->put = following;
        uint16_t bytes = used(following, ring->taken);
        if (bytes > counters->most_bytes)
            counters->most_bytes = bytes;
    }
}

static void send_more(unsigned line)
{
    struct send_ring *ring = &sending[line];
    struct uart_registers *uart = UART(line);
    uart->interrupts = UART_CLEAR_SENT;
    while (ring->taken != ring->put && !(uart->state & UART_SEND_FULL)) {
        uart->data = ring->bytes[ring->taken];
        ring->taken = next(ring->taken);
    }
}

void uart0_received(void) { receive(0); }
void uart0_sent(void) { send_more(0); }
void uart1_received(void) { receive(1); }
void uart1_sent(void) { send_more(1); }
void uart2_received(void) { receive(2); }
void uart2_sent(void) { send_more(2); }

bool lines_are_empty(void)
{
    for (unsigned line = 0; line < LINES; line++)
        if (received[line].put != received[line].taken)
            return false;
    return true;
}

int line_read(unsigned line)
{
    struct receive_ring *ring = &received[line];
    uint16_t taken = ring->taken;
    if (taken == ring->put)
        return -1;
    uint8_t byte = ring->bytes[taken];
    read_stamps[line] = ring->stamps[taken];
    ring->taken = next(taken);
    return byte;
}

void line_write(unsigned line, const uint8_t *bytes, uint16_t length)
{
    struct send_ring *ring = &sending[line];
    if (length >= RING - used(ring->put, ring->taken)) { // lost whole, as on a line without a reader
        line_counters[line].replies_lost++;
        return;
    }
    for (uint16_t i = 0; i < length; i++) {
        ring->bytes[ring->put] = bytes[i];
        ring->put = next(ring->put);
    }
    disable_interrupts();
    send_more(line);
    enable_interrupts();
}

uint32_t line_silence(unsigned line)
{
    return FPGA->counter - read_stamps[line];
}

void lines_open(const uint32_t rates[LINES])
{
    for (unsigned line = 0; line < LINES; line++) {
        UART(line)->divider = CLOCK_RATE / rates[line];
        UART(line)->control = UART_ENABLE | UART_SENT_INTERRUPT | UART_RECEIVED_INTERRUPT;
    }
}
