// SPDX-License-Identifier: MIT

#include "can.h"

#include <string.h>

#define REPLY 0x180
#define LIFE 100000 // us without a frame after which the last number and what is incomplete are forgotten
#define NUMBER_MAX 255

static uint16_t frames_of(uint16_t words)
{
    uint16_t behind = words > SEGMENT_FIRST ? (uint16_t)(words - SEGMENT_FIRST) : 0;
    return (uint16_t)(1 + (behind + SEGMENT_EACH - 1) / SEGMENT_EACH);
}

// The words of a frame lie from here on.
static uint16_t place_of(uint8_t index)
{
    return (uint16_t)(index == 0 ? 0 : SEGMENT_FIRST + SEGMENT_EACH * (index - 1));
}

void can_send_message(struct can_node *node, uint8_t number, uint8_t type, const struct words *words)
{
    for (uint8_t index = 0; index < frames_of(words->count); index++) {
        uint8_t data[8] = {number, index};
        unsigned at = 2, word = place_of(index);
        if (index == 0) {
            data[at++] = type;
            data[at++] = (uint8_t)words->count;
        }
        for (; at < 8 && word < words->count; word++) {
            data[at++] = (uint8_t)words->words[word];
            data[at++] = (uint8_t)(words->words[word] >> 8);
        }
        can_send(node, REPLY, data, 8);
    }
}

// Whether a frame is the first that comes of a message.
static bool begins(const struct can_assembly *assembly, const uint8_t data[8], uint64_t now)
{
    uint8_t number = data[0];
    if (!assembly->is_numbered)
        return data[1] == 0;
    if (assembly->number == 0 || now - assembly->heard_at > LIFE)
        return true;
    int ahead = (number + NUMBER_MAX - assembly->number) % NUMBER_MAX;
    return ahead > 0 && ahead <= NUMBER_MAX / 2;
}

// Keep the words of a frame; false: another one of this place came before.
static bool keep(struct can_assembly *assembly, const uint8_t data[8])
{
    uint8_t index = data[1];
    uint16_t words[SEGMENT_EACH], *kept = &assembly->words[place_of(index)];
    unsigned count = index == 0 ? SEGMENT_FIRST : SEGMENT_EACH;
    for (unsigned i = 0; i < count; i++)
        words[i] = can_u16(data + 8 - 2 * count + 2 * i);
    if (assembly->frames_here >> index & 1)
        return memcmp(kept, words, count * sizeof *words) == 0 &&
               (index > 0 || (assembly->type == data[2] && assembly->count == data[3]));
    assembly->frames_here |= UINT64_C(1) << index;
    memcpy(kept, words, count * sizeof *words);
    if (index == 0) {
        assembly->type = data[2];
        assembly->count = data[3];
    }
    return true;
}

bool can_assemble(struct can_assembly *assembly, const uint8_t data[8], uint64_t now)
{
    uint8_t number = data[0], index = data[1];
    if ((number != 0) != assembly->is_numbered ||
        (index == 0 ? data[3] > WORDS_MAX : index >= SEGMENTS_MAX))
        return false;
    if (begins(assembly, data, now)) {
        assembly->number = number;
        assembly->frames_here = 0;
        assembly->has_ended = false;
    } else if (assembly->has_ended || number != assembly->number) {
        return false;
    }
    assembly->heard_at = now;
    if (!keep(assembly, data)) { // of two hosts
        assembly->has_ended = true;
        return false;
    }
    uint64_t needed = (UINT64_C(1) << frames_of(assembly->count)) - 1;
    bool is_whole = (assembly->frames_here & 1) && (assembly->frames_here & needed) == needed;
    assembly->has_ended = is_whole;
    return is_whole;
}
