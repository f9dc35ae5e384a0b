// SPDX-License-Identifier: MIT
//
// The amplifier, whatever its wire: states, session, watchdog, sets, faults, and its samples.
//
// Every request is a function; it takes effect with the next sample. `amplifier_sample` makes that
// sample and is the only clock: what waits, waits a number of samples. Nothing here knows the board;
// its main loop (loop.c) hands over what is measured and takes samples and `high_voltage`.

#ifndef AMPLIFIER_H
#define AMPLIFIER_H

#include "channel.h"

struct set {
    uint16_t token, ramp, valid_for;
    uint8_t count;
    struct command commands[CHANNELS_MAX];
};

struct shapes { // the envelopes of one command, copied when it is staged
    struct envelope onset, ending;
};

struct fault_record {
    uint8_t fault, channel;
    uint64_t at; // sample
};

// Outcome of a request: refused or not, and the channel at fault.
struct verdict {
    enum nak nak;
    uint8_t channel;
};

// What the board measures: temperature, voltage, and the cause of a fault while there is one.
struct measured {
    int16_t temperature;
    uint16_t voltage;
    bool is_interlock_open;
    enum fault cause;
    uint8_t channel; // of the cause
};

struct amplifier {
    const char *serial_number; // at most 32 bytes
    struct measured measured; // of the board
    // For the board: whether the high voltage is on.
    bool high_voltage;

    enum state state;
    enum fault fault;
    uint8_t fault_channel;
    uint8_t latch;
    uint16_t session, ended_session; // 0: none
    uint64_t now;                    // samples since power-up
    uint32_t watchdog, watchdog_left; // samples

    struct set active, staged;        // token 0: none
    uint32_t valid_left, staged_left; // samples until they end; 0: nothing waits
    const struct set *answered;      // the set staged or played last
    struct shapes staged_shapes[CHANNELS_MAX];
    struct envelope slots[ENVELOPE_SLOTS];

    struct channel channels[CHANNELS_MAX];
    struct fault_record faults[FAULTS_KEPT]; // newest first
    uint8_t fault_count;
};

void amplifier_init(struct amplifier *amplifier, const char *serial_number);

// Make the next sample of every channel, and let one sample's time pass.
void amplifier_sample(struct amplifier *amplifier, int16_t samples[CHANNELS_MAX]);

// The same in units of 2^-30 of full stroke, whatever SQUARE_LAW.
void amplifier_forces(struct amplifier *amplifier, int32_t forces[CHANNELS_MAX]);

// Let time pass without samples, for a converter that was late: what waits ends sooner by as much.
void amplifier_late(struct amplifier *amplifier, uint32_t samples);

// Enter the fault reaction, whether the high voltage is on or not.
void amplifier_fail(struct amplifier *amplifier, enum fault fault, uint8_t channel);

// Hand over what the board measures; an open interlock or another cause of a fault acts at once.
void amplifier_measured(struct amplifier *amplifier, struct measured measured);

// Requests. Times are in milliseconds, ramps of Stop and Disarm are clipped.
struct verdict amplifier_arm(struct amplifier *amplifier, uint16_t watchdog, uint16_t session);
void amplifier_disarm(struct amplifier *amplifier, uint16_t ramp);
void amplifier_stop(struct amplifier *amplifier, uint16_t ramp);
struct verdict amplifier_clear(struct amplifier *amplifier, uint8_t latch);
struct verdict amplifier_ping(struct amplifier *amplifier, uint16_t session);
// Whether SetAddress may give a new address, 1 to `highest`; the line takes it, and the board keeps it.
struct verdict amplifier_readdress(const struct amplifier *amplifier, uint16_t address,
                                   uint8_t highest);
// Whether a text without its length is this amplifier's serial number.
bool amplifier_is_named(const struct amplifier *amplifier, const uint8_t *text, uint16_t length);
struct verdict amplifier_stage(struct amplifier *amplifier, uint16_t session, const struct set *set);
struct verdict amplifier_commit(struct amplifier *amplifier, uint16_t session, uint16_t token);
struct verdict amplifier_apply(struct amplifier *amplifier, uint16_t session, const struct set *set);
struct verdict amplifier_load(struct amplifier *amplifier, uint8_t slot, const struct envelope *envelope);

// Add a command to a set that is being received; refused for a channel that does not exist or
// occurs twice, so that a set never holds more commands than there are channels.
struct verdict set_add(struct set *set, const struct command *command);

// What Status and FaultList report beside the fields above.
uint8_t amplifier_flags(const struct amplifier *amplifier);
uint16_t amplifier_watchdog_left(const struct amplifier *amplifier);
uint32_t amplifier_fault_age(const struct amplifier *amplifier, uint8_t number);

// Between the files of the core.
extern const struct verdict ACCEPTED;
struct verdict refused(enum nak nak);
struct verdict session_check(const struct amplifier *amplifier, uint16_t session);
void watchdog_feed(struct amplifier *amplifier);
void sets_sample(struct amplifier *amplifier);
void settle(struct amplifier *amplifier);

#endif
