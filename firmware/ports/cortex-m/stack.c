// SPDX-License-Identifier: MIT
//
// The depth of the stack: the reset (start.c) has painted it.

#include "cortex_m.h"

extern uint32_t stack_low[], stack_top[];

uint32_t stack_used(void)
{
    const uint32_t *word = stack_low;
    while (word < stack_top && *word == STACK_PAINT)
        word++;
    return (uint32_t)((const char *)stack_top - (const char *)word);
}
