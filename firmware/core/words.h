// SPDX-License-Identifier: MIT
//
// Rows of words: read one after another, and collected. The first error of a reader stays, and what
// is read after it is 0.

#ifndef WORDS_H
#define WORDS_H

#include "protocol.h"

#include <stddef.h>

#define SERIAL_NUMBER_MAX 32 // bytes

struct reader {
    const uint16_t *at;
    uint16_t left;
    enum nak nak;
    uint8_t channel; // at fault
};

struct words {
    uint16_t count;
    uint16_t words[WORDS_MAX];
};

// A reader of so many words.
static inline struct reader reader_of(const uint16_t *words, size_t count)
{
    struct reader reader = {.at = words, .left = (uint16_t)count, .channel = NO_CHANNEL};
    return reader;
}

static inline void reader_refuse(struct reader *reader, enum nak nak, uint8_t channel)
{
    if (reader->nak == NAK_NONE) {
        reader->nak = nak;
        reader->channel = channel;
    }
}

// The next word, which must be within a range; low < 0: two's complement.
static inline int32_t read_word(struct reader *reader, int32_t low, int32_t high, enum nak nak)
{
    if (reader->left == 0)
        reader_refuse(reader, NAK_BAD_LENGTH, NO_CHANNEL);
    if (reader->nak != NAK_NONE)
        return 0;
    int32_t word = *reader->at++;
    reader->left--;
    if (low < 0 && word > INT16_MAX)
        word -= UINT16_MAX + 1;
    if (word < low || word > high) {
        reader_refuse(reader, nak, NO_CHANNEL);
        return 0;
    }
    return word;
}

static inline void put(struct words *words, uint16_t word)
{
    if (words->count < WORDS_MAX)
        words->words[words->count++] = word;
}

static inline void put_all(struct words *words, const uint16_t *from, size_t count)
{
    for (size_t i = 0; i < count; i++)
        put(words, from[i]);
}

// Put words one after another.
#define PUT(words, ...) \
    put_all(words, (const uint16_t[]){__VA_ARGS__}, sizeof((uint16_t[]){__VA_ARGS__}) / 2)

// A text: its length in bytes, then two a word, the first one high.
static inline void put_text(struct words *words, const char *text)
{
    uint16_t length = 0;
    while (text[length] != 0 && length < SERIAL_NUMBER_MAX)
        length++;
    put(words, length);
    for (uint16_t i = 0; i < length; i = (uint16_t)(i + 2))
        put(words, (uint16_t)((uint8_t)text[i] << 8 | (i + 1 < length ? (uint8_t)text[i + 1] : 0)));
}

#endif
