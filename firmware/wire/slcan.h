// SPDX-License-Identifier: MIT
//
// CAN frames as text, in the manner of serial CAN adapters (slcan, Lawicel): this amplifier and the
// adapter in front of it in one. A board with a CAN controller leaves this file out, gives received
// frames to `can_receive`, and sends those of the node.

#ifndef SLCAN_H
#define SLCAN_H

#include "can.h"

#define SLCAN_LINE_MAX 32

struct slcan {
    struct can_node *node;
    bool is_open; // the host has opened the channel
    char line[SLCAN_LINE_MAX];
    uint8_t length;
    bool is_overlong;
};

void slcan_init(struct slcan *slcan, struct can_node *node);

// Take a byte; return the answer of the adapter to a line that it ends, or null.
const char *slcan_byte(struct slcan *slcan, uint8_t byte);

// Write a frame as a line of text; return its length.
uint16_t slcan_format(const struct can_frame *frame, char line[SLCAN_LINE_MAX]);

#endif
