// SPDX-License-Identifier: MIT
//
// Sets: words that say what layers are to play, read, checked, and collected from their parts.

#ifndef SET_H
#define SET_H

#include "timer.h"
#include "words.h"

struct knot {
    uint16_t level;
    int16_t phase;
};

struct envelope {
    uint16_t step; // 0.1 ms
    uint16_t knots;
    struct knot knot[ENVELOPE_KNOTS];
};

struct command {
    uint16_t bits; // those of the next two lines, and others that must be 0
    uint8_t channel;
    bool keep_phase, skip_ending, has_onset, has_ending;
    uint16_t frequency, level;
    int16_t phase;
    struct envelope onset, ending;
};

struct layer_head {
    uint16_t bits;        // those of the next two lines, and others that must be 0
    uint8_t layer, count; // of commands
    bool after, renew;
    uint16_t ramp, valid_for; // ms
};

// Read a layer or a command with any values; the reader refuses it if the stream ends. An envelope is
// read only if the command has it.
struct layer_head read_layer(struct reader *reader);
void read_command(struct reader *reader, struct command *command);
// Skip a command.
void skip_command(struct reader *reader);

// Refuse what ends amid a layer, or is not what this amplifier plays, the first that is found.
void check_set(struct reader *reader);

#define PARTS_MAX 127

// The parts of one set but the last, in their order; once that has come, the whole set.
struct intake {
    uint16_t token;   // 0: none is under way
    bool is_staged;   // whole and checked
    bool is_overlong; // a part had no room
    uint8_t parts;    // of it
    struct timer life;
    uint8_t lengths[PARTS_MAX]; // of each part and one more; 0: it has not come
    uint16_t count;
    uint16_t words[STREAM_WORDS];
};

void intake_drop(struct intake *intake);

// Whether the bits are those of a part but the last, which nobody replies to.
static inline bool is_earlier_part(uint16_t bits)
{
    return FIELD_OF(bits, SET_INDEX) + 1 < FIELD_OF(bits, SET_PARTS);
}

// Take an earlier part at a time [us]; false: it is dropped.
bool intake_keep(struct intake *intake, uint16_t token, uint16_t bits, const struct reader *part,
                 uint64_t now);

// Take the last part. Where all others are there the set is staged, or refused whole and dropped;
// else nothing changes.
enum nak intake_take(struct intake *intake, uint16_t token, uint16_t bits, struct reader *part,
                     uint64_t now);

// Number of the first part of a set that has not come.
uint8_t intake_missing(const struct intake *intake, uint16_t token);

// Whether a token is newer than another (RFC 1982); any is newer than 0, none.
static inline bool is_newer(uint16_t token, uint16_t than)
{
    uint16_t ahead = (uint16_t)(token - than);
    return than == 0 || (ahead >= 1 && ahead <= 32767);
}

#endif
