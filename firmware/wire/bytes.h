// SPDX-License-Identifier: MIT
//
// Little-endian integers in a buffer of bytes, read and written one after another. Reading past the
// end gives zeros and sets `is_short`; writing past the end is left out and sets `is_full`.

#ifndef BYTES_H
#define BYTES_H

#include <stdbool.h>
#include <stdint.h>

struct reader {
    const uint8_t *at;
    uint16_t left;
    bool is_short;
};

struct writer {
    uint8_t *bytes;
    uint16_t length, size;
    bool is_full;
};

static inline uint8_t read_u8(struct reader *reader)
{
    if (reader->left == 0) {
        reader->is_short = true;
        return 0;
    }
    reader->left--;
    return *reader->at++;
}

static inline uint16_t read_u16(struct reader *reader)
{
    uint8_t low = read_u8(reader);
    return (uint16_t)(low | read_u8(reader) << 8);
}

static inline int16_t read_i16(struct reader *reader)
{
    return (int16_t)read_u16(reader);
}

static inline bool is_read_whole(const struct reader *reader)
{
    return !reader->is_short && reader->left == 0;
}

static inline void write_u8(struct writer *writer, uint8_t value)
{
    if (writer->length == writer->size)
        writer->is_full = true;
    else
        writer->bytes[writer->length++] = value;
}

static inline void write_u16(struct writer *writer, uint16_t value)
{
    write_u8(writer, (uint8_t)value);
    write_u8(writer, (uint8_t)(value >> 8));
}

static inline void write_u32(struct writer *writer, uint32_t value)
{
    write_u16(writer, (uint16_t)value);
    write_u16(writer, (uint16_t)(value >> 16));
}

#endif
