// SPDX-License-Identifier: MIT
//
// The main loop of an amplifier on a board.

#ifndef LOOP_H
#define LOOP_H

void loop_init(void);

// Make samples that are due, then carry out what has arrived. Call it for ever, and `board_wait`
// between two calls.
void loop_once(void);

// Make the samples that are due. Before a request is carried out, so that it takes effect when it
// arrived, however long ago the loop made samples.
void loop_samples(void);

// For a board with Modbus on other lines than LINE_MODBUS.
struct modbus *loop_modbus(void);

#endif
