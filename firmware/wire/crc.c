// SPDX-License-Identifier: MIT

#include "crc.h"

uint32_t crc32_of(const uint8_t *bytes, uint16_t length)
{
    uint32_t crc = UINT32_MAX;
    while (length-- > 0) {
        crc ^= *bytes++;
        for (int bit = 0; bit < 8; bit++)
            crc = (crc & 1) ? crc >> 1 ^ UINT32_C(0xEDB88320) : crc >> 1;
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
