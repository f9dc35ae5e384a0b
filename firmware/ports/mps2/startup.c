// SPDX-License-Identifier: MIT
//
// From reset to main on a Cortex-M3: the vectors, initial data, and zeros.

#include "open.h"

#include <stdint.h>

extern uint32_t data_source[], data_begin[], data_end[], bss_begin[], bss_end[], stack_top[];
int main(void);

static void halt(void)
{
    for (;;) {
    }
}

void reset(void)
{
    const uint32_t *from = data_source;
    for (uint32_t *to = data_begin; to < data_end; to++)
        *to = *from++;
    for (uint32_t *to = bss_begin; to < bss_end; to++)
        *to = 0;
    main();
    halt();
}

// The SysTick has nothing to do but to wake the processor.
static void tick(void)
{
}

// Of the processor: reset, faults, SysTick. Then those of the board, of which UARTs 0, 1 and 3 receive.
__attribute__((section(".vectors"), used)) static const struct {
    uint32_t *stack;
    void (*of_processor[15])(void);
    void (*of_board[19])(void);
} vectors = {
    stack_top,
    {reset, halt, halt, halt, halt, halt, 0, 0, 0, 0, halt, halt, 0, halt, tick},
    {[0] = board_received, [2] = board_received, [18] = board_received},
};
