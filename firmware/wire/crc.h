// SPDX-License-Identifier: MIT
//
// The checksums of the wires. They are computed bit by bit: slow, but without tables; a fast line on
// a slow processor deserves a table or the processor's own unit.

#ifndef CRC_H
#define CRC_H

#include <stdint.h>

// CRC-32 of Ethernet and zlib, of serial frames and of CAN serial numbers.
uint32_t crc32_of(const uint8_t *bytes, uint16_t length);

// CRC-16 of Modbus RTU.
uint16_t crc16_of(const uint8_t *bytes, uint16_t length);

#endif
