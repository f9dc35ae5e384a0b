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
    uint8_t knots;
    struct knot knot[ENVELOPE_KNOTS];
};

struct command {
    uint8_t channel;
    bool keep_phase, skip_ending, has_onset, has_ending;
    uint16_t frequency, level;
    int16_t phase;
    struct envelope onset, ending;
};

struct layer_head {
    uint8_t layer, count; // of commands
    bool after, renew;
    uint16_t ramp, valid_for; // ms
};

// Read what comes next; a number that no set can have is refused by the reader.
struct layer_head read_layer(struct reader *reader);
struct command read_command(struct reader *reader);

// Refuse what this amplifier does not play.
void check_set(struct reader *reader);

#define PARTS_MAX 127

// The parts of one set, in their order with room for those that are missing; then the whole set.
struct intake {
    uint16_t token;   // 0: none is under way
    bool is_staged;   // whole and checked
    uint8_t parts;    // of it
    struct timer life;
    uint8_t lengths[PARTS_MAX]; // of each part and one more; 0: it has not come
    uint16_t count;
    uint16_t words[STREAM_WORDS];
};

void intake_drop(struct intake *intake);

// Take a part at a time [us]; refused: nothing changes but that a set which cannot be played is
// dropped. After the last part it is staged.
enum nak intake_take(struct intake *intake, uint16_t token, uint16_t bits, struct reader *part,
                     uint64_t now);

// Number of the first part that is missing.
uint8_t intake_missing(const struct intake *intake);

// Whether a token is newer than another (RFC 1982); any is newer than 0, none.
static inline bool is_newer(uint16_t token, uint16_t than)
{
    uint16_t ahead = (uint16_t)(token - than);
    return than == 0 || (ahead >= 1 && ahead <= 32767);
}

#endif
