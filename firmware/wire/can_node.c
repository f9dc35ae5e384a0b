// SPDX-License-Identifier: MIT

#include "can.h"

#include <string.h>

enum nmt_command { START = 1, STOP = 2, ENTER_PRE_OPERATIONAL = 128, RESET_NODE, RESET_COMMUNICATION };

// Functions: identifiers without the number of the node.
#define NMT 0x000
#define EMERGENCY 0x080
#define ANSWER 0x180
#define COMMAND 0x200 // to 0x500, of channels 0 to 3
#define ORDER 0x480
#define SDO_REQUEST 0x600
#define SLOTS 0x680
#define HEARTBEAT 0x700

#define HEARTBEAT_INTERVAL 50 // ms, until object 1017 is written

void can_send(struct can_node *node, uint16_t function, uint64_t data, uint8_t length)
{
    struct can_frame frame = {(uint16_t)(function + node->number), length, {0}};
    for (unsigned i = 0; i < 8; i++)
        frame.data[i] = (uint8_t)(data >> 8 * i);
    node->send(&frame);
}

static void boot(struct can_node *node)
{
    node->number = node->next_number;
    node->nmt = NMT_PRE_OPERATIONAL;
    node->heartbeat_interval = HEARTBEAT_INTERVAL;
    node->heartbeat_at = node->amplifier->now;
    node->seen_state = node->amplifier->state;
    node->seen_fault = node->amplifier->fault;
    node->collection.is_open = false;
    node->sdo.transfer = SDO_IDLE;
    can_send(node, HEARTBEAT, NMT_BOOT_UP, 1);
}

void can_init(struct can_node *node, struct amplifier *amplifier, uint8_t number,
              void (*send)(const struct can_frame *frame))
{
    memset(node, 0, sizeof *node);
    node->amplifier = amplifier;
    node->next_number = number;
    node->send = send;
    boot(node);
}

uint8_t can_error_register(enum fault fault)
{
    static const uint8_t REGISTERS[] = {0x00, 0x11, 0x09, 0x05, 0x03, 0x81, 0x81, 0x01, 0x03};
    return REGISTERS[fault];
}

static uint16_t error_code(enum fault fault)
{
    static const uint16_t CODES[] = {0x0000, 0x8130, 0x4310, 0x3310, 0x2340,
                                     0xFF01, 0x6100, 0x9000, 0x2310};
    return CODES[fault];
}

static bool is_fault_state(enum state state)
{
    return state == FAULT_REACTION_ACTIVE || state == FAULT;
}

// Report a change of state or fault: an emergency to, within or from a fault, else an answer that
// answers nothing.
void can_report_change(struct can_node *node)
{
    const struct amplifier *amplifier = node->amplifier;
    enum state state = amplifier->state, before = node->seen_state;
    enum fault fault = amplifier->fault;
    uint64_t both = (uint64_t)state | (uint64_t)fault << 4;
    if (state == before && fault == node->seen_fault)
        return;
    node->seen_state = state;
    node->seen_fault = fault;
    if (node->nmt == NMT_STOPPED)
        return;
    if (is_fault_state(state) || is_fault_state(before))
        can_send(node, EMERGENCY,
                 error_code(fault) | (uint64_t)can_error_register(fault) << 16 | both << 24 |
                     (uint64_t)amplifier->fault_channel << 32,
                 8);
    else if (node->nmt == NMT_OPERATIONAL)
        can_send(node, ANSWER, both << 16 | (uint64_t)NO_CHANNEL << 24, 8);
}

static void leave_operational(struct can_node *node, enum nmt next)
{
    // It would no longer receive its host.
    if (node->amplifier->state == OPERATION_ENABLED)
        amplifier_stop(node->amplifier, SAFETY_RAMP);
    can_report_change(node);
    node->collection.is_open = false;
    node->nmt = next;
}

static void manage(struct can_node *node, uint8_t command)
{
    switch (command) {
    case START:
        node->nmt = NMT_OPERATIONAL;
        break;
    case STOP:
        leave_operational(node, NMT_STOPPED);
        break;
    case ENTER_PRE_OPERATIONAL:
        leave_operational(node, NMT_PRE_OPERATIONAL);
        break;
    case RESET_NODE: // like a loss of supply
        amplifier_init(node->amplifier, node->amplifier->serial_number);
        node->consumer = 0;
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

static void receive_pdo(struct can_node *node, uint16_t function, uint64_t data)
{
    switch (function) {
    case ORDER:
        can_order(node, data, false);
        break;
    case SLOTS:
        can_slots(node, data);
        break;
    case COMMAND:
    case COMMAND + 0x100:
    case COMMAND + 0x200:
    case COMMAND + 0x300:
        can_command(node, (uint8_t)((function - COMMAND) >> 8), data);
        break;
    default:
        break;
    }
}

void can_receive(struct can_node *node, const struct can_frame *frame)
{
    uint16_t function = (uint16_t)(frame->id - node->number);
    uint64_t data = u64_at(frame->data);
    if (frame->id == NMT) {
        if (frame->length == 2 && (frame->data[1] == 0 || frame->data[1] == node->number))
            manage(node, frame->data[0]);
    } else if (frame->id == HEARTBEAT + HOST_OF(node)) {
        if (frame->length == 1 && HOST_OF(node) != 0)
            amplifier_ping(node->amplifier, HOST_OF(node));
    } else if (frame->length != 8) {
        return; // discarded
    } else if (function == SDO_REQUEST && node->nmt != NMT_STOPPED) {
        can_sdo_receive(node, frame->data);
    } else if (frame->id == ORDER && node->nmt == NMT_OPERATIONAL) {
        can_order(node, data, true);
    } else if (node->nmt == NMT_OPERATIONAL) {
        receive_pdo(node, function, data);
    }
}

void can_time(struct can_node *node)
{
    uint64_t interval = (uint64_t)node->heartbeat_interval * SAMPLES_PER_MS;
    can_report_change(node);
    can_expire(node);
    if (interval > 0 && node->amplifier->now - node->heartbeat_at >= interval) {
        node->heartbeat_at = node->amplifier->now;
        can_send(node, HEARTBEAT, node->nmt, 1);
    }
}
