// SPDX-License-Identifier: MIT
//
// Command-line options of the POSIX port; without any it is --serial:
//
//     --serial              serve the serial protocol on a pseudo-terminal; prints its URL
//     --modbus-rtu          serve Modbus RTU on a pseudo-terminal; prints its URL
//     --modbus-tcp PORT     serve Modbus TCP on 127.0.0.1, 0 being any port; prints its URL
//     --slcan               serve CAN as text on a pseudo-terminal; prints its URL
//     --samples FILE        write the samples: 16-bit integers, the channels one after another
//     --serial-number TEXT  of the amplifier
//     --until-eof           end with standard input
//
// The signal USR1 opens its interlock, and closes it again.

#ifndef OPTIONS_H
#define OPTIONS_H

// Open what the options ask for, or exit with a message.
void board_open(int count, char **arguments);

#endif
