// SPDX-License-Identifier: MIT
//
// Functions that the files of this port have in common.

#ifndef CORTEX_M_H
#define CORTEX_M_H

#include <stdint.h>

void board_open(void);

// Once per pass of the main loop: keep the processor's watchdog from expiring.
void board_feed_watchdog(void);

// Switch the high voltage off and silence the converter; writes registers and one buffer only.
void board_shut_down(void);

void tick(void);

#define STACK_PAINT UINT32_C(0xA5A5A5A5)

// Bytes of the stack in use or used since the reset.
uint32_t stack_used(void);

#endif
