// SPDX-License-Identifier: MIT

#include "can.h"

#include <string.h>

enum action { STATUS = 0, APPLY, STAGE, COMMIT, ARM, DISARM, STOP, CLEAR };

#define INCOMPLETE_SET 15 // a result beside those of Nak
#define COLLECTED_LIFE 100 // ms

#define ANSWER 0x180
#define CONDITION 0x280
#define LEVELS 0x380

#define ACTION(order) ((enum action)field(order, 48, 3))
#define COUNT(order) field(order, 51, 5)
#define SEQUENCE(frame) ((uint8_t)((frame) >> 56))

// Hosts have node numbers up to 127; a session of CAN is such a number, and may come again.
#define HOST_MAX 127

uint64_t can_condition(const struct can_node *node, uint8_t sequence)
{
    const struct amplifier *amplifier = node->amplifier;
    return sequence | (uint64_t)amplifier_flags(amplifier) << 8 |
           (uint64_t)(uint16_t)amplifier->measured.temperature << 16 |
           (uint64_t)amplifier->measured.voltage << 32 | (uint64_t)CHANNELS << 48 |
           (uint64_t)amplifier->latch << 56;
}

uint64_t can_levels(const struct can_node *node, uint8_t sequence)
{
    uint64_t frame = (uint64_t)sequence << 56;
    for (unsigned i = 0; i < CHANNELS; i++)
        frame |= (uint64_t)channel_level(&node->amplifier->channels[i]) << 14 * i;
    return frame;
}

static void answer(struct can_node *node, uint64_t order, unsigned result, uint8_t channel)
{
    const struct amplifier *amplifier = node->amplifier;
    enum action action = ACTION(order);
    bool is_exact = result == 0 && (action == APPLY || action == STAGE || action == COMMIT);
    node->last_answer = SEQUENCE(order) | (uint64_t)action << 8 | (uint64_t)is_exact << 11 |
                        (uint64_t)result << 12 | (uint64_t)amplifier->state << 16 |
                        (uint64_t)amplifier->fault << 20 | (uint64_t)channel << 24 |
                        (uint64_t)amplifier->active.token << 32 |
                        (uint64_t)amplifier_watchdog_left(amplifier) << 48;
    can_report_change(node);
    if (result == 0 && !is_exact) {
        can_send(node, LEVELS, can_levels(node, SEQUENCE(order)), 8);
        can_send(node, CONDITION, can_condition(node, SEQUENCE(order)), 8);
    }
    can_send(node, ANSWER, node->last_answer, 8);
}

static struct verdict arm(struct can_node *node, uint64_t order)
{
    uint16_t host = field(order, 0, 16), watchdog = field(order, 32, 16);
    if (host < 1 || host > HOST_MAX)
        return refused(NAK_BAD_VALUE);
    if (node->amplifier->ended_session == host)
        node->amplifier->ended_session = 0;
    struct verdict verdict = amplifier_arm(node->amplifier, watchdog, host);
    if (verdict.nak == NAK_NONE)
        node->consumer = (uint32_t)host << 16 | watchdog;
    return verdict;
}

// Carry out an order that needs no further frames.
static struct verdict carry_out(struct can_node *node, uint64_t order)
{
    struct amplifier *amplifier = node->amplifier;
    switch (ACTION(order)) {
    case COMMIT:
        return amplifier_commit(amplifier, HOST_OF(node), field(order, 0, 16));
    case ARM:
        return arm(node, order);
    case DISARM:
        amplifier_disarm(amplifier, field(order, 16, 16));
        return ACCEPTED;
    case STOP:
        amplifier_stop(amplifier, field(order, 16, 16));
        return ACCEPTED;
    case CLEAR:
        if (field(order, 0, 16) > UINT8_MAX)
            return refused(NAK_BAD_VALUE);
        return amplifier_clear(amplifier, (uint8_t)order);
    default:
        return ACCEPTED;
    }
}

static bool is_newer(uint8_t a, uint8_t b)
{
    unsigned ahead = (a + 255u - b) % 255;
    return ahead >= 1 && ahead <= 127;
}

// Whether a frame with this number belongs to the set that is collected, which it may begin.
static bool collects(struct can_node *node, uint8_t sequence)
{
    struct can_collection *collection = &node->collection;
    if (sequence == 0)
        return false;
    if (collection->is_open && sequence != collection->sequence &&
        !is_newer(sequence, collection->sequence))
        return false;
    if (!collection->is_open || sequence != collection->sequence) {
        memset(collection, 0, sizeof *collection);
        collection->is_open = true;
        collection->sequence = sequence;
        collection->since = node->amplifier->now;
    }
    return true;
}

static bool is_complete(const struct can_collection *collection)
{
    unsigned count = 0;
    if (!collection->has_order)
        return false;
    for (unsigned i = 0; i < CHANNELS; i++) {
        if (!(collection->commands_here >> i & 1))
            continue;
        bool is_shaped = field(collection->commands[i], 50, 1) != 0;
        if (is_shaped && !(collection->slots_here >> i / 4 & 1))
            return false;
        count++;
    }
    return count == COUNT(collection->order);
}

static struct verdict read_command(const struct can_collection *collection, uint8_t channel,
                                   struct command *command)
{
    uint64_t frame = collection->commands[channel], slots = collection->slots[channel / 4];
    struct verdict bad = {NAK_BAD_CHANNEL, (uint8_t)field(frame, 52, 4)};
    if (bad.channel != channel) // it is in the identifier as well
        return bad;
    command->channel = channel;
    command->frequency = field(frame, 0, 16);
    command->level = field(frame, 16, 16);
    command->phase = (int16_t)field(frame, 32, 16);
    command->flags = (uint8_t)field(frame, 48, 4); // bit 3 is undefined and refused with the set
    if (command->flags & HAS_ENVELOPES) {
        command->onset = (uint8_t)field(slots, 12 * (channel % 4u), 6);
        command->ending = (uint8_t)field(slots, 12 * (channel % 4u) + 6, 6);
    }
    return ACCEPTED;
}

static struct verdict read_set(const struct can_collection *collection, struct set *set)
{
    memset(set, 0, sizeof *set);
    set->token = field(collection->order, 0, 16);
    set->ramp = field(collection->order, 16, 16);
    set->valid_for = field(collection->order, 32, 16);
    for (uint8_t i = 0; i < CHANNELS; i++) {
        if (!(collection->commands_here >> i & 1))
            continue;
        struct command command = {0};
        struct verdict verdict = read_command(collection, i, &command);
        if (verdict.nak != NAK_NONE)
            return verdict;
        set_add(set, &command);
    }
    return ACCEPTED;
}

// Play or stage what is collected as soon as its last frame has come.
static void try_set(struct can_node *node)
{
    struct can_collection *collection = &node->collection;
    struct set set;
    if (!is_complete(collection))
        return;
    struct verdict verdict = read_set(collection, &set);
    if (verdict.nak == NAK_NONE && ACTION(collection->order) == APPLY)
        verdict = amplifier_apply(node->amplifier, HOST_OF(node), &set);
    else if (verdict.nak == NAK_NONE)
        verdict = amplifier_stage(node->amplifier, HOST_OF(node), &set);
    collection->is_open = false;
    answer(node, collection->order, verdict.nak, verdict.channel);
}

void can_order(struct can_node *node, uint64_t order, bool is_broadcast)
{
    enum action action = ACTION(order);
    if (is_broadcast) {
        if (SEQUENCE(order) == 0 && (action == STOP || action == COMMIT))
            carry_out(node, order);
        return;
    }
    if (SEQUENCE(order) == 0)
        return;
    node->last_order = order;
    if (action == APPLY || action == STAGE) {
        if (!collects(node, SEQUENCE(order)))
            return;
        node->collection.has_order = true;
        node->collection.order = order;
        try_set(node);
        return;
    }
    if (node->collection.is_open && is_newer(SEQUENCE(order), node->collection.sequence))
        node->collection.is_open = false;
    struct verdict verdict = carry_out(node, order);
    answer(node, order, verdict.nak, verdict.channel);
}

void can_command(struct can_node *node, uint8_t channel, uint64_t command)
{
    if (channel >= CHANNELS || !collects(node, SEQUENCE(command)))
        return;
    node->collection.commands_here |= (uint8_t)(1u << channel);
    node->collection.commands[channel] = command;
    try_set(node);
}

void can_slots(struct can_node *node, uint64_t slots)
{
    unsigned group = field(slots, 48, 2);
    if (group >= (CHANNELS + 3) / 4 || !collects(node, SEQUENCE(slots)))
        return;
    node->collection.slots_here |= (uint8_t)(1u << group);
    node->collection.slots[group] = slots;
    try_set(node);
}

void can_expire(struct can_node *node)
{
    struct can_collection *collection = &node->collection;
    if (!collection->is_open ||
        node->amplifier->now - collection->since < COLLECTED_LIFE * SAMPLES_PER_MS)
        return;
    collection->is_open = false;
    if (collection->has_order)
        answer(node, collection->order, INCOMPLETE_SET, NO_CHANNEL);
}

uint64_t can_command_bits(const struct command *command)
{
    return command->frequency | (uint64_t)command->level << 16 |
           (uint64_t)(uint16_t)command->phase << 32 | (uint64_t)command->flags << 48 |
           (uint64_t)command->channel << 52;
}
