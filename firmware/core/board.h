// SPDX-License-Identifier: MIT
//
// The 14 functions of a board. All return immediately, except `board_wait`. Only the main loop (loop.c)
// calls them. See README.md, "Port to another board".

#ifndef BOARD_H
#define BOARD_H

#include "config.h"
#include "records.h"

enum line { LINE_SERIAL, LINE_MODBUS, LINE_CAN };

// Time and samples.

// Real time [us], of another clock than the converter's: it ends watchdog and vibrations even where
// no samples are taken.
uint64_t board_microseconds(void);
// Samples that are due since the last call, by the clock of the converter. ahead, read together with
// them and unbiased: by how much the next one will come out later than now, in 2^-16 of a sample: of
// one, less what the converter's timer has counted, and what lies in a buffer before it.
uint32_t board_samples_due(int32_t *ahead);
// Hand the next sample of every channel to the converter; 32767 is full level.
void board_output(const int16_t samples[CHANNELS_MAX]);
// Go on sending; then sleep until a sample is due or a byte has arrived.
void board_wait(void);

// Lines.

// The next byte that has arrived, or -1. A ring of 512 bytes is enough in each direction: the longest
// request and reply have 256.
int board_read(enum line line);
// Begin to send; the bytes are copied. If they do not fit, none of them is sent.
void board_write(enum line line, const uint8_t *bytes, uint16_t length);
// Microseconds since the byte that was read last arrived; later bytes may be waiting. The interrupt
// that receives a byte stores its time with it. Silence ends a frame of Modbus RTU, and Mark stores
// the clock at its last byte.
uint32_t board_silence(enum line line);

// High voltage, and what is measured.

void board_high_voltage(bool on);
struct readings board_readings(void); // in the units that records.h says
bool board_interlock_open(void);
// The cause of another fault while there is one, and its channel (NO_CHANNEL: none).
enum fault board_fault(uint8_t *channel);

// Who it is.

const char *board_serial_number(void); // unique, at most 32 bytes of UTF-8; never changes
// Of this amplifier on a line: on serial and Modbus 1 to 247, on CAN 1 to 127. 1 until one is stored.
uint8_t board_address(enum line line);
// Keep an address that a host has set, also without supply.
void board_store_address(enum line line, uint8_t address);

#endif
