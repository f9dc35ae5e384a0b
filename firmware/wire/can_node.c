// SPDX-License-Identifier: MIT

#include "can.h"
#include "messages.h"

#include <string.h>

enum nmt_command { START = 1, LEAVE = 2, ENTER_PRE_OPERATIONAL = 128, RESET_NODE, RESET_COMMUNICATION };

// Functions: identifiers without the number of the node.
#define NMT 0x000
#define EMERGENCY 0x080
#define REQUEST 0x200 // without a node: a broadcast
#define SDO_REQUEST 0x600
#define HEARTBEAT 0x700

#define HEARTBEAT_INTERVAL 50 // ms, until object 1017 is written
#define LEAVING_RAMP 5        // ms

static void send_heartbeat(struct can_node *node, enum nmt nmt)
{
    uint8_t state = (uint8_t)nmt;
    node->heartbeat_at = node->amplifier->now;
    can_send(node, HEARTBEAT, &state, 1);
}

static void boot(struct can_node *node)
{
    memset(&node->requests, 0, sizeof node->requests);
    node->requests.is_numbered = true;
    node->nmt = NMT_PRE_OPERATIONAL;
    node->heartbeat_interval = HEARTBEAT_INTERVAL;
    node->sdo.is_uploading = false;
    send_heartbeat(node, NMT_BOOT_UP);
}

void can_init(struct can_node *node, struct amplifier *amplifier, uint8_t number,
              void (*send)(const struct can_frame *frame))
{
    memset(node, 0, sizeof *node);
    node->amplifier = amplifier;
    node->number = number;
    node->send = send;
    node->broadcasts.has_ended = true;
    boot(node);
}

void can_event(struct can_node *node, const struct wire_event *event)
{
    struct words words = {.count = 0};
    enum fault fault = (enum fault)event->fault;
    bool is_faulty = fault != FAULT_NONE;
    put_event(&words, event);
    if (node->nmt == NMT_OPERATIONAL)
        can_send_message(node, 0, MESSAGE_EVENT, &words);
    if ((is_faulty || node->was_faulty) && node->nmt != NMT_STOPPED) {
        struct can_emergency emergency = can_emergency(fault);
        uint8_t data[8] = {(uint8_t)emergency.code, (uint8_t)(emergency.code >> 8),
                           emergency.error_register,
                           (uint8_t)(event->state | event->fault << 4), (uint8_t)event->channel};
        can_send(node, EMERGENCY, data, 8);
    }
    node->was_faulty = is_faulty;
}

// Leave the state in which it receives requests: its host would be deaf to what plays.
static void leave_operational(struct can_node *node, enum nmt next)
{
    if (node->amplifier->state == OPERATION_ENABLED)
        amplifier_stop(node->amplifier, LEAVING_RAMP);
    node->nmt = next;
}

static void manage(struct can_node *node, uint8_t command)
{
    switch (command) {
    case START:
        node->nmt = NMT_OPERATIONAL;
        break;
    case LEAVE:
        leave_operational(node, NMT_STOPPED);
        break;
    case ENTER_PRE_OPERATIONAL:
        leave_operational(node, NMT_PRE_OPERATIONAL);
        break;
    case RESET_NODE: // like a loss of supply
        amplifier_restart(node->amplifier);
        boot(node);
        break;
    case RESET_COMMUNICATION:
        leave_operational(node, NMT_PRE_OPERATIONAL);
        boot(node);
        break;
    default:
        break;
    }
}

// Carry a message out; its reply goes to a numbered one.
static void handle(struct can_node *node, const struct can_assembly *message)
{
    struct words reply = {.count = 0};
    struct verdict verdict = {.channel = NO_CHANNEL};
    uint8_t type = message->type;
    uint16_t address = message->words[SET_ADDRESS_ADDRESS];
    bool is_moving = type == MESSAGE_SET_ADDRESS && message->count > 0;
    if (type == MESSAGE_HELLO && message->is_numbered)
        message_identity(&reply, node->amplifier);
    else if (is_moving && address > NODE_MAX)
        verdict.nak = NAK_BAD_VALUE;
    else
        verdict = message_handle(node->amplifier, type, message->words, message->count,
                                 message->is_numbered ? &reply : NULL);
    is_moving = is_moving && verdict.nak == NAK_NONE && address != node->number;
    if (verdict.nak != NAK_NONE) {
        message_nak(&reply, type, verdict);
        type = MESSAGE_NAK;
    }
    if (message->is_numbered && reply.count > 0)
        can_send_message(node, message->number, type, &reply);
    if (is_moving) {
        node->number = (uint8_t)address;
        boot(node);
    }
}

void can_receive(struct can_node *node, const struct can_frame *frame)
{
    uint16_t function = (uint16_t)(frame->id - node->number);
    uint64_t now = node->amplifier->now;
    if (frame->id == NMT) {
        if (frame->length == 2 && (frame->data[1] == 0 || frame->data[1] == node->number))
            manage(node, frame->data[0]);
    } else if (frame->length != 8) {
        return; // discarded
    } else if (function == SDO_REQUEST) {
        if (node->nmt != NMT_STOPPED)
            can_sdo_receive(node, frame->data);
    } else if (node->nmt != NMT_OPERATIONAL) {
        return; // until it is identified
    } else if (frame->id == REQUEST) {
        if (can_assemble(&node->broadcasts, frame->data, now))
            handle(node, &node->broadcasts);
    } else if (function == REQUEST) {
        if (can_assemble(&node->requests, frame->data, now))
            handle(node, &node->requests);
    }
}

void can_time(struct can_node *node)
{
    uint64_t interval = (uint64_t)node->heartbeat_interval * 1000;
    if (interval > 0 && node->amplifier->now - node->heartbeat_at >= interval)
        send_heartbeat(node, node->nmt);
}
