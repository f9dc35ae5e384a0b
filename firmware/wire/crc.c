// SPDX-License-Identifier: MIT

#include "crc.h"

// The CRC-32 of each half byte, reflected: the polynomial 0xEDB88320.
static const uint32_t HALF_BYTES[16] = {
    0x00000000, 0x1DB71064, 0x3B6E20C8, 0x26D930AC, 0x76DC4190, 0x6B6B51F4, 0x4DB26158, 0x5005713C,
    0xEDB88320, 0xF00F9344, 0xD6D6A3E8, 0xCB61B38C, 0x9B64C2B0, 0x86D3D2D4, 0xA00AE278, 0xBDBDF21C,
};

uint32_t crc32_of(const uint8_t *bytes, uint16_t length)
{
    uint32_t crc = UINT32_MAX;
    while (length-- > 0) {
        crc ^= *bytes++;
        crc = crc >> 4 ^ HALF_BYTES[crc & 15];
        crc = crc >> 4 ^ HALF_BYTES[crc & 15];
    }
    return ~crc;
}

uint16_t crc16_of(const uint8_t *bytes, uint16_t length)
{
    uint16_t crc = UINT16_MAX;
    while (length-- > 0) {
        crc ^= *bytes++;
        for (int bit = 0; bit < 8; bit++)
            crc = (uint16_t)((crc & 1) ? crc >> 1 ^ 0xA001 : crc >> 1);
    }
    return crc;
}
