// SPDX-License-Identifier: MIT
//
// The main loop of an amplifier on a board.

#ifndef LOOP_H
#define LOOP_H

#include <stdbool.h>

void loop_init(void);

// Make samples that are due, then carry out requests. Call it forever. Return whether to call
// `board_wait` now: no sample is overdue. Under load, samples are made for at most a quarter of
// LATE_MAX before bytes are read. If samples are later than LATE_MAX, all channels fall silent in a
// fault (FAULT_INTERNAL).
bool loop_once(void);

// Make the samples that are due, within the same limit. Called before a request is carried out, so
// that it takes effect at its time of arrival.
void loop_samples(void);

// For a board with Modbus on other lines than LINE_MODBUS.
struct modbus *loop_modbus(void);

#endif
