// SPDX-License-Identifier: MIT
//
// States, session, watchdog, stops and faults.

#include "amplifier.h"

#include <string.h>

const struct verdict ACCEPTED = {NAK_NONE, NO_CHANNEL};

struct verdict refused(enum nak nak)
{
    struct verdict verdict = {nak, NO_CHANNEL};
    return verdict;
}

void amplifier_init(struct amplifier *amplifier, const char *serial_number)
{
    memset(amplifier, 0, sizeof *amplifier);
    amplifier->serial_number = serial_number;
    amplifier->state = SWITCH_ON_DISABLED;
    amplifier->fault_channel = NO_CHANNEL;
    amplifier->answered = &amplifier->active;
}

static bool is_sounding(const struct amplifier *amplifier)
{
    for (unsigned i = 0; i < CHANNELS; i++)
        if (channel_is_sounding(&amplifier->channels[i]))
            return true;
    return false;
}

// Every channel falls silent along a ramp; endings are skipped.
static void quiet(struct amplifier *amplifier, uint16_t ramp)
{
    for (unsigned i = 0; i < CHANNELS; i++)
        channel_quiet(&amplifier->channels[i], ramp);
}

static void leave_operation(struct amplifier *amplifier, enum state next)
{
    if (amplifier->state == OPERATION_ENABLED) {
        amplifier->ended_session = amplifier->session;
        amplifier->session = 0;
        amplifier->watchdog_left = 0;
        amplifier->staged_left = 0;
        amplifier->valid_left = 0;
    }
    amplifier->state = next;
}

static void next_latch(struct amplifier *amplifier)
{
    amplifier->latch = amplifier->latch == 255 ? 1 : amplifier->latch + 1;
}

// Once silent: what only waited for that.
void settle(struct amplifier *amplifier)
{
    if (amplifier->state == OPERATION_ENABLED || is_sounding(amplifier))
        return;
    amplifier->high_voltage = false;
    if (amplifier->state == SWITCHED_ON)
        amplifier->state = SWITCH_ON_DISABLED;
    if (amplifier->state == FAULT_REACTION_ACTIVE)
        amplifier->state = FAULT;
}

void amplifier_fail(struct amplifier *amplifier, enum fault fault, uint8_t channel)
{
    leave_operation(amplifier, FAULT_REACTION_ACTIVE);
    amplifier->fault = fault;
    amplifier->fault_channel = channel;
    next_latch(amplifier);
    memmove(&amplifier->faults[1], &amplifier->faults[0],
            (FAULTS_KEPT - 1) * sizeof amplifier->faults[0]);
    amplifier->faults[0].fault = (uint8_t)fault;
    amplifier->faults[0].channel = channel;
    amplifier->faults[0].at = amplifier->now;
    if (amplifier->fault_count < FAULTS_KEPT)
        amplifier->fault_count++;
    quiet(amplifier, SAFETY_RAMP);
    settle(amplifier);
}

void amplifier_measured(struct amplifier *amplifier, struct measured measured)
{
    amplifier->measured = measured;
    if (!amplifier->high_voltage || amplifier->fault != FAULT_NONE)
        return;
    if (measured.is_interlock_open)
        amplifier_fail(amplifier, FAULT_INTERLOCK, NO_CHANNEL);
    else if (measured.cause != FAULT_NONE)
        amplifier_fail(amplifier, measured.cause, measured.channel);
}

static bool is_cause_gone(const struct amplifier *amplifier)
{
    if (amplifier->fault == FAULT_INTERLOCK)
        return !amplifier->measured.is_interlock_open;
    return amplifier->measured.cause == FAULT_NONE;
}

void watchdog_feed(struct amplifier *amplifier)
{
    amplifier->watchdog_left = amplifier->watchdog;
}

struct verdict session_check(const struct amplifier *amplifier, uint16_t session)
{
    if (amplifier->state != OPERATION_ENABLED)
        return refused(NAK_WRONG_STATE);
    return session == amplifier->session ? ACCEPTED : refused(NAK_WRONG_SESSION);
}

struct verdict amplifier_arm(struct amplifier *amplifier, uint16_t watchdog, uint16_t session)
{
    if (watchdog < WATCHDOG_MIN || watchdog > WATCHDOG_MAX || session == 0)
        return refused(NAK_BAD_VALUE);
    if (amplifier->state > OPERATION_ENABLED || amplifier->measured.is_interlock_open)
        return refused(NAK_WRONG_STATE);
    if (amplifier->state == OPERATION_ENABLED) {
        if (session != amplifier->session)
            return refused(NAK_WRONG_SESSION);
    } else {
        if (session == amplifier->ended_session)
            return refused(NAK_WRONG_SESSION);
        amplifier->state = OPERATION_ENABLED;
        amplifier->session = session;
        amplifier->high_voltage = true;
        amplifier->active.token = 0;
        quiet(amplifier, SAFETY_RAMP);
    }
    amplifier->watchdog = (uint32_t)watchdog * SAMPLES_PER_MS;
    watchdog_feed(amplifier);
    return ACCEPTED;
}

void amplifier_disarm(struct amplifier *amplifier, uint16_t ramp)
{
    if (amplifier->state == OPERATION_ENABLED)
        leave_operation(amplifier, SWITCHED_ON);
    quiet(amplifier, ramp > RAMP_MAX ? RAMP_MAX : ramp);
    settle(amplifier);
}

void amplifier_stop(struct amplifier *amplifier, uint16_t ramp)
{
    next_latch(amplifier);
    if (amplifier->state < QUICK_STOP_ACTIVE)
        leave_operation(amplifier, QUICK_STOP_ACTIVE);
    quiet(amplifier, ramp > RAMP_MAX ? RAMP_MAX : ramp);
    settle(amplifier);
}

struct verdict amplifier_clear(struct amplifier *amplifier, uint8_t latch)
{
    if (amplifier->state != QUICK_STOP_ACTIVE && amplifier->state != FAULT)
        return ACCEPTED;
    if (latch != amplifier->latch)
        return refused(NAK_WRONG_LATCH);
    if (is_sounding(amplifier) || (amplifier->state == FAULT && !is_cause_gone(amplifier)))
        return ACCEPTED; // too early: nothing changes, as the status shows
    amplifier->state = SWITCH_ON_DISABLED;
    amplifier->fault = FAULT_NONE;
    amplifier->fault_channel = NO_CHANNEL;
    return ACCEPTED;
}

struct verdict amplifier_ping(struct amplifier *amplifier, uint16_t session)
{
    if (amplifier->state != OPERATION_ENABLED)
        return ACCEPTED;
    if (session != amplifier->session)
        return refused(NAK_WRONG_SESSION);
    watchdog_feed(amplifier);
    return ACCEPTED;
}

struct verdict amplifier_readdress(const struct amplifier *amplifier, uint16_t address,
                                   uint8_t highest)
{
    if (!(FEATURES & FEATURE_ADDRESS))
        return refused(NAK_UNKNOWN_TYPE);
    if (address < 1 || address > highest)
        return refused(NAK_BAD_VALUE);
    return amplifier->state == SWITCH_ON_DISABLED ? ACCEPTED : refused(NAK_WRONG_STATE);
}

bool amplifier_is_named(const struct amplifier *amplifier, const uint8_t *text, uint16_t length)
{
    return length == strlen(amplifier->serial_number) &&
           memcmp(text, amplifier->serial_number, length) == 0;
}

void amplifier_forces(struct amplifier *amplifier, int32_t forces[CHANNELS_MAX])
{
    for (unsigned i = 0; i < CHANNELS; i++)
        forces[i] = channel_force(&amplifier->channels[i]);
    amplifier->now++;
    settle(amplifier);
    if (amplifier->state != OPERATION_ENABLED)
        return;
    sets_sample(amplifier);
    amplifier->watchdog_left--;
    if (amplifier->watchdog_left == 0)
        amplifier_fail(amplifier, FAULT_WATCHDOG, NO_CHANNEL);
}

void amplifier_sample(struct amplifier *amplifier, int16_t samples[CHANNELS_MAX])
{
    int32_t forces[CHANNELS_MAX];
    bool is_on = amplifier->high_voltage || !SQUARE_LAW; // without it no bias either
    amplifier_forces(amplifier, forces);
    for (unsigned i = 0; i < CHANNELS; i++)
        samples[i] = is_on ? sample_of(forces[i]) : 0;
}

static void shorten(uint32_t *left, uint32_t samples)
{
    if (*left > 0) // the last one ends with the next sample
        *left = *left > samples ? *left - samples : 1;
}

void amplifier_late(struct amplifier *amplifier, uint32_t samples)
{
    shorten(&amplifier->watchdog_left, samples);
    shorten(&amplifier->valid_left, samples);
    shorten(&amplifier->staged_left, samples);
}

uint8_t amplifier_flags(const struct amplifier *amplifier)
{
    return (uint8_t)((amplifier->high_voltage ? HIGH_VOLTAGE_ON : 0) |
                     (amplifier->measured.is_interlock_open ? INTERLOCK_OPEN : 0));
}

uint16_t amplifier_watchdog_left(const struct amplifier *amplifier)
{
    uint16_t left = (uint16_t)(amplifier->watchdog_left / SAMPLES_PER_MS);
    return left == 0 && amplifier->watchdog_left > 0 ? 1 : left;
}

uint32_t amplifier_fault_age(const struct amplifier *amplifier, uint8_t number)
{
    uint64_t age = (amplifier->now - amplifier->faults[number].at) / SAMPLES_PER_MS;
    return age > UINT32_MAX ? UINT32_MAX : (uint32_t)age;
}
