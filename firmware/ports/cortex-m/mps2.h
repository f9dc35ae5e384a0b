// SPDX-License-Identifier: MIT
//
// Registers of Arm's MPS2 board with the image AN385: Cortex-M3 at 25 MHz.

#ifndef MPS2_H
#define MPS2_H

#include <stdint.h>

#define CLOCK_RATE 25000000 // Hz; of processor, timers and UARTs
#define CYCLES_PER_US (CLOCK_RATE / 1000000)

struct uart_registers {
    volatile uint32_t data, state, control, interrupts, divider;
};
struct timer_registers {
    volatile uint32_t control, value, reload, interrupts;
};
struct watchdog_registers {
    volatile uint32_t reload, value, control, clear;
};
struct fpga_registers {
    volatile uint32_t leds, reserved0, buttons, reserved1, hertz, hundred_hertz, counter, prescale;
};

#define UART(line) ((struct uart_registers *)(uintptr_t)(0x40004000 + 0x1000 * (uint32_t)(line)))
#define CONVERTER_TIMER ((struct timer_registers *)(uintptr_t)0x40000000)
#define TICK_TIMER ((struct timer_registers *)(uintptr_t)0x40001000)
#define WATCHDOG ((struct watchdog_registers *)(uintptr_t)0x40008000)
#define FPGA ((struct fpga_registers *)(uintptr_t)0x40028000)
#define INTERRUPTS_ENABLE (*(volatile uint32_t *)(uintptr_t)0xE000E100)

#define UART_SEND_FULL 1u     // state
#define UART_RECEIVED 2u
#define UART_OVERRUN 8u
#define UART_ENABLE 3u        // control: send and receive
#define UART_SENT_INTERRUPT 4u
#define UART_RECEIVED_INTERRUPT 8u
#define UART_CLEAR_SENT 1u    // interrupts
#define UART_CLEAR_RECEIVED 2u
#define TIMER_ENABLE 1u
#define TIMER_INTERRUPT 8u
#define WATCHDOG_ENABLE 3u    // first an NMI, then a reset
#define UART_INTERRUPTS 0x3Fu // of UART 0 to 2
#define TICK_INTERRUPT (1u << 9)

static inline void disable_interrupts(void)
{
    __asm volatile("cpsid i" ::: "memory");
}

static inline void enable_interrupts(void)
{
    __asm volatile("cpsie i" ::: "memory");
}

// Sleep until an interrupt is pending, also while interrupts are disabled.
static inline void wait_for_interrupt(void)
{
    __asm volatile("wfi" ::: "memory");
}

#endif
