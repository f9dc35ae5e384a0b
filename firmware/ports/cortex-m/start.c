// SPDX-License-Identifier: MIT
//
// Vectors and reset of a Cortex-M. The reset initializes memory for C and paints the stack, so that
// `stack_used` can measure it.

#include "cortex_m.h"
#include "lines.h"

#include <stddef.h>
#include <string.h>

#define RESET_FRAME 32 // words that `reset` itself may use

extern uint32_t data_begin[], data_end[], data_in_code[], bss_begin[], bss_end[];
extern uint32_t stack_low[], stack_top[];

int main(void);

static size_t bytes_between(const uint32_t *from, const uint32_t *to)
{
    return (size_t)((const char *)to - (const char *)from);
}

// Any processor fault, and the first expiry of the watchdog (NMI); its second expiry is a reset.
static void shut_down(void)
{
    board_shut_down();
    for (;;) {
    }
}

void reset(void)
{
    uint32_t *frame;
    __asm volatile("mov %0, sp" : "=r"(frame));
    for (uint32_t *word = stack_low; word < frame - RESET_FRAME; word++)
        *word = STACK_PAINT;
    memcpy(data_begin, data_in_code, bytes_between(data_begin, data_end));
    memset(bss_begin, 0, bytes_between(bss_begin, bss_end));
    main();
    shut_down();
}

typedef void handler(void);

static const struct {
    uint32_t *stack;
    handler *reset, *nmi, *hard_fault, *memory_fault, *bus_fault, *usage_fault, *reserved0[4];
    handler *supervisor_call, *debug, *reserved1, *pending_call, *system_tick;
    handler *interrupts[16];
} vectors __attribute__((section(".vectors"), used)) = {
    .stack = stack_top,
    .reset = reset,
    .nmi = shut_down,
    .hard_fault = shut_down,
    .memory_fault = shut_down,
    .bus_fault = shut_down,
    .usage_fault = shut_down,
    .supervisor_call = shut_down,
    .debug = shut_down,
    .pending_call = shut_down,
    .system_tick = shut_down,
    .interrupts = {[0] = uart0_received, [1] = uart0_sent, [2] = uart1_received, [3] = uart1_sent,
                   [4] = uart2_received, [5] = uart2_sent, [9] = tick},
};
