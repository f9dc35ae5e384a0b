// SPDX-License-Identifier: MIT
//
// Lines of the board: interrupts move bytes between UARTs and rings.

#ifndef LINES_H
#define LINES_H

#include <stdbool.h>
#include <stdint.h>

#define LINES 3
#define RING 512 // bytes each way, a power of two; the longest reply has 256

// Open all lines with their rates [baud].
void lines_open(const uint32_t rates[LINES]);

int line_read(unsigned line);
void line_write(unsigned line, const uint8_t *bytes, uint16_t length);
uint32_t line_silence(unsigned line); // us

// Whether no byte is waiting to be read.
bool lines_are_empty(void);

// For a debugger: bytes and replies lost because a ring was full, and the most bytes it has held.
struct line_counters {
    uint32_t bytes_lost, replies_lost, most_bytes;
};
extern struct line_counters line_counters[LINES];

// Handlers of the interrupts.
void uart0_received(void);
void uart0_sent(void);
void uart1_received(void);
void uart1_sent(void);
void uart2_received(void);
void uart2_sent(void);

#endif
