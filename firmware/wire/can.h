// SPDX-License-Identifier: MIT
//
// A CANopen node (docs/reference/wire-can.md): frames in, frames out, whatever carries them.
//
//     can_node.c     network management, heartbeats, emergencies
//     can_orders.c   orders and their answers, the collection of a set
//     can_objects.c  the object dictionary
//     can_sdo.c      access to it

#ifndef CAN_H
#define CAN_H

#include "amplifier.h"

enum nmt { NMT_BOOT_UP = 0, NMT_STOPPED = 4, NMT_OPERATIONAL = 5, NMT_PRE_OPERATIONAL = 127 };

struct can_frame {
    uint16_t id;
    uint8_t length;
    uint8_t data[8];
};

// A set while its frames arrive, in any order, all with one sequence number.
struct can_collection {
    bool is_open, has_order;
    uint8_t sequence;
    uint64_t since; // sample of its first frame
    uint64_t order;
    uint8_t commands_here, slots_here; // a bit for each channel; for each group of four
    uint64_t commands[CHANNELS_MAX];
    uint64_t slots[(CHANNELS_MAX + 3) / 4];
};

#define SDO_BUFFER 140
#define NODE_MAX 63

struct can_sdo {
    enum { SDO_IDLE, SDO_UPLOAD, SDO_DOWNLOAD } transfer;
    uint16_t index;
    uint8_t subindex;
    bool toggle;
    uint8_t bytes[SDO_BUFFER];
    uint16_t length, at;
};

struct can_node {
    struct amplifier *amplifier;
    uint8_t number, next_number; // the next one from a reset on
    void (*send)(const struct can_frame *frame);
    enum nmt nmt;
    uint16_t heartbeat_interval; // ms; 0: none
    uint64_t heartbeat_at;       // sample of the last one
    uint32_t consumer;           // object 1016: host and watchdog
    enum state seen_state;       // as last reported
    enum fault seen_fault;
    uint64_t last_answer, last_order;
    struct can_collection collection;
    struct can_sdo sdo;
};

void can_init(struct can_node *node, struct amplifier *amplifier, uint8_t number,
              void (*send)(const struct can_frame *frame));
void can_receive(struct can_node *node, const struct can_frame *frame);

// What is due: heartbeats, events, the end of a set that stays incomplete. Call it every millisecond.
void can_time(struct can_node *node);

// Between the files of the node.
#define HOST_OF(node) ((uint16_t)((node)->consumer >> 16 & 0x7F))
void can_send(struct can_node *node, uint16_t function, uint64_t data, uint8_t length);
void can_report_change(struct can_node *node);
void can_order(struct can_node *node, uint64_t order, bool is_broadcast);
void can_command(struct can_node *node, uint8_t channel, uint64_t command);
void can_slots(struct can_node *node, uint64_t slots);
void can_expire(struct can_node *node);
uint64_t can_condition(const struct can_node *node, uint8_t sequence);
uint64_t can_levels(const struct can_node *node, uint8_t sequence);
uint64_t can_command_bits(const struct command *command);
uint8_t can_error_register(enum fault fault);
void can_sdo_receive(struct can_node *node, const uint8_t request[8]);
uint32_t can_read_object(const struct can_node *node, struct can_sdo *into);
uint32_t can_write_object(struct can_node *node, const struct can_sdo *from);

static inline uint64_t u64_at(const uint8_t bytes[8])
{
    uint64_t value = 0;
    for (int i = 7; i >= 0; i--)
        value = value << 8 | bytes[i];
    return value;
}

// A field of a frame, as in the table of the page.
static inline uint16_t field(uint64_t frame, unsigned first_bit, unsigned bits)
{
    return (uint16_t)(frame >> first_bit & ((UINT32_C(1) << bits) - 1));
}

#endif
