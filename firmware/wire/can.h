// SPDX-License-Identifier: MIT
//
// A CANopen node (docs/reference/can.md): frames in, frames out, whatever carries them.
//
//     can_node.c      network management, heartbeats, events, emergencies
//     can_segments.c  messages in frames of three words
//     can_objects.c   the object dictionary
//     can_sdo.c       access to it

#ifndef CAN_H
#define CAN_H

#include "amplifier.h"

#include <string.h>

enum nmt { NMT_BOOT_UP = 0, NMT_STOPPED = 4, NMT_OPERATIONAL = 5, NMT_PRE_OPERATIONAL = 127 };

#define NODE_MAX 127

struct can_frame {
    uint16_t id;
    uint8_t length;
    uint8_t data[8];
};

// What is said of a fault.
struct can_emergency {
    uint16_t code;
    uint8_t error_register;
};

#define SEGMENT_FIRST 2 // words of frame 0, behind type and count
#define SEGMENT_EACH 3  // of the others
#define SEGMENTS_MAX (1 + (WORDS_MAX - SEGMENT_FIRST + SEGMENT_EACH - 1) / SEGMENT_EACH)

// A message of one sender while its frames arrive, in any order.
struct can_assembly {
    bool is_numbered;     // else frame 0 begins a message
    uint8_t number;       // of the message; 0: none yet
    bool has_ended;       // whole, or discarded
    uint64_t heard_at;    // us; of its last frame
    uint64_t frames_here; // a bit each
    uint8_t type, count;
    uint16_t words[SEGMENT_FIRST + SEGMENT_EACH * (SEGMENTS_MAX - 1)];
};

// Take a frame of eight bytes; return whether it completes a message.
bool can_assemble(struct can_assembly *assembly, const uint8_t data[8], uint64_t now);

#define SDO_BUFFER 64

struct can_sdo {
    bool is_uploading, toggle;
    uint16_t index;
    uint8_t subindex;
    uint8_t bytes[SDO_BUFFER];
    uint16_t length, at;
};

struct can_node {
    struct amplifier *amplifier;
    uint8_t number;
    void (*send)(const struct can_frame *frame);
    enum nmt nmt;
    uint16_t heartbeat_interval; // ms; 0: none
    uint64_t heartbeat_at;       // us; of the last one
    bool was_faulty;             // when it last sent an event
    struct can_assembly requests, broadcasts;
    struct can_sdo sdo;
};

void can_init(struct can_node *node, struct amplifier *amplifier, uint8_t number,
              void (*send)(const struct can_frame *frame));
void can_receive(struct can_node *node, const struct can_frame *frame);

// Report a change of state.
void can_event(struct can_node *node, const struct wire_event *event);

// Send a heartbeat that is due. Call it every millisecond.
void can_time(struct can_node *node);

// Between the files of the node.

// Send a frame; function: its identifier without the number of the node.
static inline void can_send(struct can_node *node, uint16_t function, const uint8_t *data,
                            uint8_t length)
{
    struct can_frame frame = {.id = (uint16_t)(function + node->number), .length = length};
    memcpy(frame.data, data, length);
    node->send(&frame);
}

void can_send_message(struct can_node *node, uint8_t number, uint8_t type,
                      const struct words *words);
struct can_emergency can_emergency(enum fault fault);
void can_sdo_receive(struct can_node *node, const uint8_t request[8]);
// Abort codes, or 0.
uint32_t can_read_object(const struct can_node *node, struct can_sdo *into);
uint32_t can_write_object(struct can_node *node, const struct can_sdo *from);

static inline uint16_t can_u16(const uint8_t *bytes)
{
    return (uint16_t)(bytes[0] | bytes[1] << 8);
}

#endif
