// SPDX-License-Identifier: MIT
//
// The main loop of an amplifier on a board.

#ifndef LOOP_H
#define LOOP_H

void loop_init(void);

// Make samples that are due, then carry out what has arrived. Call it for ever, and `board_wait`
// between two calls.
void loop_once(void);

// For a board with Modbus on other lines than LINE_MODBUS.
struct modbus *loop_modbus(void);

#endif
