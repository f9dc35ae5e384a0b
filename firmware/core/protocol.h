// SPDX-License-Identifier: MIT
//
// Numbers of the protocol that hold on every wire: states, faults, refusals, and the units of what
// is sent. See docs/reference/wire-protocol.md, sections Numbers, States and Nak.

#ifndef PROTOCOL_H
#define PROTOCOL_H

#include <stdbool.h>
#include <stdint.h>

#define PROTOCOL_VERSION 2

enum state {
    NOT_READY = 0,
    SWITCH_ON_DISABLED = 1, // disarmed
    READY_TO_SWITCH_ON = 2,
    SWITCHED_ON = 3,        // falling silent after a Disarm
    OPERATION_ENABLED = 4,  // armed
    QUICK_STOP_ACTIVE = 5,
    FAULT_REACTION_ACTIVE = 6,
    FAULT = 7
};

enum fault {
    FAULT_NONE = 0,
    FAULT_WATCHDOG = 1,
    FAULT_OVER_TEMPERATURE = 2,
    FAULT_OVER_VOLTAGE = 3,
    FAULT_ARC = 4,
    FAULT_CHANNEL = 5,
    FAULT_INTERNAL = 6,
    FAULT_INTERLOCK = 7,
    FAULT_OVER_CURRENT = 8
};

enum nak {
    NAK_NONE = 0, // not refused
    NAK_UNKNOWN_TYPE = 1,
    NAK_BAD_LENGTH = 2,
    NAK_BAD_VALUE = 3,
    NAK_BAD_CHANNEL = 4,
    NAK_WRONG_STATE = 5,
    NAK_BAD_TOKEN = 6,
    NAK_BUSY = 7,
    NAK_UNSUPPORTED_VERSION = 8,
    NAK_NO_ENVELOPE = 9,
    NAK_WRONG_SESSION = 10,
    NAK_WRONG_LATCH = 11,
    NAK_FADING = 12
};

#define NO_CHANNEL 255

// Units: frequency 0.05 Hz, level 0.0001 of full stroke, phase 0.01 degrees, times 1 ms, the step
// of an envelope 0.1 ms, temperature 0.1 degrees Celsius, voltage 1 V.
#define FREQUENCY_PER_HZ 20
#define FULL_STROKE 10000
#define PHASE_MIN (-18000)
#define PHASE_MAX 17999
#define PHASE_TURN 36000
#define SERIAL_NUMBER_MAX 32 // bytes
#define RAMP_MAX 1000
#define VALID_FOR_MAX 60000
#define STAGED_LIFE 1000    // ms until a staged set is forgotten
#define SAFETY_RAMP 5       // ms; of the watchdog, of faults, and of what an Arm still finds playing
#define ENVELOPE_SLOT_MAX 63
#define ADDRESS_MAX 247     // on the serial line and Modbus

// Features.
#define FEATURE_EVENTS 0x0001
#define FEATURE_ADDRESS 0x0800

// Flags of Status.
#define HIGH_VOLTAGE_ON 0x01
#define INTERLOCK_OPEN 0x02

// Flags of a command.
#define KEEP_PHASE 0x01
#define SKIP_ENDING 0x02
#define HAS_ENVELOPES 0x04  // onset and ending follow, on the serial line
#define COMMAND_FLAGS (KEEP_PHASE | SKIP_ENDING | HAS_ENVELOPES)

#endif
