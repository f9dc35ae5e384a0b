// SPDX-License-Identifier: MIT
//
// Protocol 4 in numbers, made by docs/generators/firmware_header.py: do not edit it. A message is a
// row of 16-bit words (docs/reference/protocol.md). REQUEST_FIELD is the place of a field in
// the words of a request; small fields share a word, out of which FIELD_OF takes one. Ranges of
// quantities are those of the wire. Replies are in records.h.

#ifndef PROTOCOL_H
#define PROTOCOL_H

#include <stdbool.h>
#include <stdint.h>

#define FIELD_OF(bits, field) ((bits) >> field##_SHIFT & field##_MASK)

enum {
    PROTOCOL_VERSION = 4, WORDS_MAX = 120, NO_CHANNEL = 255, STAGED_LIFE_MS = 1000,
    SHORTENED_FADE_MS = 2, CLOCK_TURN = 20, AHEAD_MAX = 1638, FREQUENCY_PER_UNIT = 20,
    WIRE_LEVEL_MAX = 10000, LEVEL_PER_UNIT = 10000, WIRE_PHASE_MIN = -18000,
    WIRE_PHASE_MAX = 17999, PHASE_PER_UNIT = 100, WIRE_RAMP_MAX = 1000, WIRE_VALID_FOR_MAX = 60000,
    WIRE_WATCHDOG_MIN = 100, WIRE_WATCHDOG_MAX = 2000, WIRE_ENVELOPE_STEP_MAX = 1000,
};

enum state {
    NOT_READY = 0, SWITCH_ON_DISABLED = 1, READY_TO_SWITCH_ON = 2, SWITCHED_ON = 3,
    OPERATION_ENABLED = 4, QUICK_STOP_ACTIVE = 5, FAULT_REACTION_ACTIVE = 6, FAULT = 7,
};

enum fault {
    FAULT_NONE = 0, FAULT_WATCHDOG = 1, FAULT_OVER_TEMPERATURE = 2, FAULT_OVER_VOLTAGE = 3,
    FAULT_ARC = 4, FAULT_CHANNEL = 5, FAULT_INTERNAL = 6, FAULT_INTERLOCK = 7,
    FAULT_OVER_CURRENT = 8,
};

enum nak {
    NAK_NONE = 0, NAK_UNKNOWN_TYPE = 1, NAK_BAD_LENGTH = 2, NAK_BAD_VALUE = 3, NAK_BAD_CHANNEL = 4,
    NAK_WRONG_STATE = 5, NAK_BAD_TOKEN = 6, NAK_BUSY = 7, NAK_UNSUPPORTED_VERSION = 8,
    NAK_WRONG_SESSION = 10, NAK_WRONG_LATCH = 11, NAK_INCOMPLETE = 12,
};

enum message {
    MESSAGE_HELLO = 1, MESSAGE_GET_CAPS = 2, MESSAGE_ARM = 3, MESSAGE_DISARM = 4, MESSAGE_SET = 5,
    MESSAGE_COMMIT = 6, MESSAGE_SILENCE = 7, MESSAGE_STOP = 8, MESSAGE_GET_STATUS = 9,
    MESSAGE_GET_FAULTS = 10, MESSAGE_CLEAR = 11, MESSAGE_PING = 12, MESSAGE_GET_ACHIEVED = 13,
    MESSAGE_GET_MEASURED = 14, MESSAGE_SET_ADDRESS = 15, MESSAGE_MARK = 19, MESSAGE_EVENT = 30,
    MESSAGE_NAK = 31,
};

enum {
    FLAG_HIGH_VOLTAGE = 1, FLAG_INTERLOCK_OPEN = 2, FLAG_LIMITED = 4,
};

enum {
    FEATURE_OUTPUT = 1, FEATURE_EVENTS = 2, FEATURE_LEVELS_MEASURED = 4, FEATURE_INTERLOCK = 8,
    FEATURE_ELECTRICAL = 16, FEATURE_ADDRESS = 64, FEATURE_MARK = 128,
};

enum {
    ARM_SESSION = 0, ARM_WATCHDOG = 1, ARM_SHIFT = 2,
    DISARM_RAMP = 0,
    SET_SESSION = 0, SET_TOKEN = 1, SET_BITS = 2, SET_STREAM = 3, SET_INDEX_SHIFT = 8,
    SET_INDEX_MASK = 255, SET_PARTS_SHIFT = 1, SET_PARTS_MASK = 127, SET_NOW_SHIFT = 0,
    SET_NOW_MASK = 1, SET_BITS_MAX = 65535,
    COMMIT_SESSION = 0, COMMIT_TOKEN = 1, COMMIT_AT = 2,
    SILENCE_SESSION = 0, SILENCE_RAMP = 1,
    STOP_RAMP = 0,
    CLEAR_LATCH = 0,
    PING_SESSION = 0, PING_RATE = 1,
    GET_ACHIEVED_LAYER = 0,
    SET_ADDRESS_ADDRESS = 0, SET_ADDRESS_SERIAL_NUMBER = 1,
    LAYER_LAYER_SHIFT = 7, LAYER_LAYER_MASK = 15, LAYER_AFTER_SHIFT = 6, LAYER_AFTER_MASK = 1,
    LAYER_RENEW_SHIFT = 5, LAYER_RENEW_MASK = 1, LAYER_COUNT_SHIFT = 0, LAYER_COUNT_MASK = 31,
    LAYER_BITS_MAX = 2047,
    COMMAND_CHANNEL_SHIFT = 4, COMMAND_CHANNEL_MASK = 15, COMMAND_KEEP_PHASE_SHIFT = 3,
    COMMAND_KEEP_PHASE_MASK = 1, COMMAND_SKIP_ENDING_SHIFT = 2, COMMAND_SKIP_ENDING_MASK = 1,
    COMMAND_ONSET_SHIFT = 1, COMMAND_ONSET_MASK = 1, COMMAND_ENDING_SHIFT = 0,
    COMMAND_ENDING_MASK = 1, COMMAND_BITS_MAX = 255,
};

// Each request: whether it may be a broadcast, feeds the watchdog and so names its session where,
// has words behind its fields; how many fields; lowest and highest value of each, and how others
// are refused.
#define REQUEST_FIELDS_MAX 3
#define WITHIN(lowest, highest, code) {.low = lowest, .high = highest, .nak = NAK_##code}
#define REQUEST_TABLE \
    [MESSAGE_GET_CAPS] = {.fields = 0}, \
    [MESSAGE_ARM] = {.feeds = true, .session = ARM_SESSION, .fields = 3, \
        .field = {WITHIN(1, 65535, BAD_VALUE), WITHIN(100, 2000, BAD_VALUE), \
        WITHIN(0, 65535, BAD_VALUE)}}, \
    [MESSAGE_DISARM] = {.fields = 1, .field = {WITHIN(0, 65535, BAD_VALUE)}}, \
    [MESSAGE_SET] = {.feeds = true, .has_tail = true, .session = SET_SESSION, .fields = 3, \
        .field = {WITHIN(1, 65535, BAD_VALUE), WITHIN(1, 65535, BAD_TOKEN), \
        WITHIN(0, 65535, BAD_VALUE)}}, \
    [MESSAGE_COMMIT] = {.is_broadcast = true, .feeds = true, .session = COMMIT_SESSION, \
        .fields = 3, .field = {WITHIN(1, 65535, BAD_VALUE), WITHIN(1, 65535, BAD_TOKEN), \
        WITHIN(0, 65535, BAD_VALUE)}}, \
    [MESSAGE_SILENCE] = {.feeds = true, .session = SILENCE_SESSION, .fields = 2, \
        .field = {WITHIN(1, 65535, BAD_VALUE), WITHIN(0, 1000, BAD_VALUE)}}, \
    [MESSAGE_STOP] = {.is_broadcast = true, .fields = 1, .field = {WITHIN(0, 65535, BAD_VALUE)}}, \
    [MESSAGE_GET_STATUS] = {.fields = 0}, \
    [MESSAGE_GET_FAULTS] = {.fields = 0}, \
    [MESSAGE_CLEAR] = {.fields = 1, .field = {WITHIN(0, 65535, BAD_VALUE)}}, \
    [MESSAGE_PING] = {.feeds = true, .session = PING_SESSION, .fields = 2, \
        .field = {WITHIN(1, 65535, BAD_VALUE), WITHIN(-32768, 32767, BAD_VALUE)}}, \
    [MESSAGE_GET_ACHIEVED] = {.fields = 1, .field = {WITHIN(0, 15, BAD_VALUE)}}, \
    [MESSAGE_GET_MEASURED] = {.fields = 0}, \
    [MESSAGE_SET_ADDRESS] = {.is_broadcast = true, .has_tail = true, .fields = 1, \
        .field = {WITHIN(1, 247, BAD_VALUE)}}, \
    [MESSAGE_MARK] = {.is_broadcast = true, .fields = 0},

// Of each fault: code of the emergency, and the error register meanwhile (CiA 301).
#define EMERGENCY_TABLE \
    [FAULT_NONE] = {.code = 0x0000, .error_register = 0x00}, \
    [FAULT_WATCHDOG] = {.code = 0x8130, .error_register = 0x11}, \
    [FAULT_OVER_TEMPERATURE] = {.code = 0x4310, .error_register = 0x09}, \
    [FAULT_OVER_VOLTAGE] = {.code = 0x3310, .error_register = 0x05}, \
    [FAULT_ARC] = {.code = 0x2340, .error_register = 0x03}, \
    [FAULT_CHANNEL] = {.code = 0xFF01, .error_register = 0x81}, \
    [FAULT_INTERNAL] = {.code = 0x6100, .error_register = 0x81}, \
    [FAULT_INTERLOCK] = {.code = 0x9000, .error_register = 0x01}, \
    [FAULT_OVER_CURRENT] = {.code = 0x2310, .error_register = 0x03},

#endif
