// SPDX-License-Identifier: MIT
//
// States, session, watchdog, stops and faults.

#include "amplifier.h"
#include "sine.h"

#include <string.h>

#define SAFETY_RAMP 5 // ms; of the watchdog, of faults, and of what an Arm still finds playing

// Beyond full level by more than a step.
#define LIMIT (ONE + ONE / LEVEL_PER_UNIT)

static void enter(struct amplifier *amplifier, enum state state, uint8_t channel)
{
    if (state == amplifier->state)
        return;
    amplifier->state = state;
    amplifier->changed = amplifier->sample;
    if (state == OPERATION_ENABLED)
        amplifier->high_voltage = true;
    if (amplifier->notify != NULL) {
        struct wire_event event = {
            .state = (uint16_t)state,
            .fault = (uint16_t)amplifier->fault,
            .channel = channel,
            .latch = amplifier->latch,
        };
        amplifier->notify(amplifier, &event);
    }
}

void amplifier_init(struct amplifier *amplifier, const char *serial_number,
                    amplifier_notify *notify)
{
    memset(amplifier, 0, sizeof *amplifier);
    amplifier->serial_number = serial_number;
    amplifier->notify = notify;
    amplifier->state = SWITCH_ON_DISABLED;
    amplifier_steer(amplifier, 0);
}

void amplifier_steer(struct amplifier *amplifier, int16_t rate)
{
    // 2^64 in 20 s, too much by less than 1 for each sample: by 2 us in a year at 48 kHz.
    const int64_t step = (int64_t)(UINT64_MAX / (CLOCK_TURN * SAMPLE_RATE) + 1);
    amplifier->step = (uint64_t)(step + step * rate / 10000000);
}

void amplifier_skip(struct amplifier *amplifier, uint64_t samples)
{
    amplifier->clock += amplifier->step * samples;
}

void amplifier_restart(struct amplifier *amplifier)
{
    layers_silence(amplifier, 0);
    intake_drop(&amplifier->intake);
    timer_stop(&amplifier->fed);
    amplifier_steer(amplifier, 0);
    amplifier->committed = amplifier->session = amplifier->latch = 0;
    amplifier->high_voltage = amplifier->is_limited = false;
    amplifier->fault = FAULT_NONE;
    enter(amplifier, SWITCH_ON_DISABLED, NO_CHANNEL);
}

static bool is_silent(const struct amplifier *amplifier)
{
    for (unsigned i = 0; i < CHANNELS; i++)
        if (!channel_is_silent(&amplifier->channels[i]))
            return false;
    return true;
}

static void next_latch(struct amplifier *amplifier)
{
    amplifier->latch = amplifier->latch == UINT16_MAX ? 1 : (uint16_t)(amplifier->latch + 1);
}

// Once silent: what only waited for that.
static void settle(struct amplifier *amplifier)
{
    if (amplifier->state == OPERATION_ENABLED || !is_silent(amplifier))
        return;
    amplifier->high_voltage = false;
    if (amplifier->state == SWITCHED_ON)
        enter(amplifier, SWITCH_ON_DISABLED, NO_CHANNEL);
    if (amplifier->state == FAULT_REACTION_ACTIVE)
        enter(amplifier, FAULT, NO_CHANNEL);
}

void amplifier_silence(struct amplifier *amplifier, uint16_t ramp)
{
    layers_silence(amplifier, ramp);
    intake_drop(&amplifier->intake);
}

// Silence, then the state that follows.
static void leave(struct amplifier *amplifier, enum state next, uint16_t ramp, uint8_t channel)
{
    amplifier_silence(amplifier, ramp);
    timer_stop(&amplifier->fed);
    amplifier_steer(amplifier, 0);
    enter(amplifier, next, channel);
    settle(amplifier);
}

void amplifier_fail(struct amplifier *amplifier, enum fault fault, uint8_t channel)
{
    struct fault_record record = {
        .fault = (uint8_t)fault, .channel = channel, .at = amplifier_now(amplifier)};
    amplifier->fault = fault;
    next_latch(amplifier);
    memmove(&amplifier->faults[1], &amplifier->faults[0],
            (FAULTS_KEPT - 1) * sizeof amplifier->faults[0]);
    amplifier->faults[0] = record;
    if (amplifier->fault_count < FAULTS_KEPT)
        amplifier->fault_count++;
    leave(amplifier, FAULT_REACTION_ACTIVE, SAFETY_RAMP, channel);
}

static bool can_fail(const struct amplifier *amplifier)
{
    return amplifier->state >= SWITCHED_ON && amplifier->state <= QUICK_STOP_ACTIVE;
}

void amplifier_overload(struct amplifier *amplifier)
{
    if (can_fail(amplifier))
        amplifier_fail(amplifier, FAULT_INTERNAL, NO_CHANNEL);
    amplifier_silence(amplifier, 0);
    settle(amplifier);
}

void amplifier_measured(struct amplifier *amplifier, struct measured measured)
{
    amplifier->measured = measured;
    if (!can_fail(amplifier))
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

void amplifier_feed(struct amplifier *amplifier)
{
    if (amplifier->state == OPERATION_ENABLED)
        timer_start(&amplifier->fed, amplifier->watchdog, amplifier->now);
}

void amplifier_arm(struct amplifier *amplifier, uint16_t session, uint16_t watchdog, uint16_t shift)
{
    amplifier->watchdog = watchdog;
    if (amplifier->state == OPERATION_ENABLED) // the same again: its reply was lost
        return;
    amplifier_silence(amplifier, SAFETY_RAMP);
    amplifier->committed = 0;
    amplifier->session = session;
    amplifier->clock += (uint64_t)shift << 48;
    enter(amplifier, OPERATION_ENABLED, NO_CHANNEL);
}

void amplifier_disarm(struct amplifier *amplifier, uint16_t ramp)
{
    enum state next = amplifier->state == OPERATION_ENABLED ? SWITCHED_ON : amplifier->state;
    leave(amplifier, next, ramp > RAMP_MAX ? RAMP_MAX : ramp, NO_CHANNEL);
}

void amplifier_stop(struct amplifier *amplifier, uint16_t ramp)
{
    bool is_kept = amplifier->state == NOT_READY || amplifier->state >= QUICK_STOP_ACTIVE;
    next_latch(amplifier);
    leave(amplifier, is_kept ? amplifier->state : QUICK_STOP_ACTIVE,
          ramp > RAMP_MAX ? RAMP_MAX : ramp, NO_CHANNEL);
}

enum nak amplifier_clear(struct amplifier *amplifier, uint16_t latch)
{
    if (amplifier->state != QUICK_STOP_ACTIVE && amplifier->state != FAULT)
        return NAK_NONE;
    if (latch != amplifier->latch)
        return NAK_WRONG_LATCH;
    if (!is_silent(amplifier) || (amplifier->state == FAULT && !is_cause_gone(amplifier)))
        return NAK_NONE; // too early: nothing changes, as the status shows
    amplifier->fault = FAULT_NONE;
    enter(amplifier, SWITCH_ON_DISABLED, NO_CHANNEL);
    return NAK_NONE;
}

void amplifier_forces(struct amplifier *amplifier, int32_t forces[CHANNELS_MAX])
{
    uint32_t clock = (uint32_t)(amplifier->clock >> 32);
    for (unsigned i = 0; i < CHANNELS; i++) {
        int64_t sum = channel_sum(&amplifier->channels[i], clock);
        amplifier->is_limited |= sum > LIMIT || sum < -LIMIT;
        forces[i] = sum > ONE ? ONE : sum < -ONE ? -ONE : (int32_t)sum;
    }
    amplifier->sample++;
    amplifier->clock += amplifier->step;
    layers_sample(amplifier);
    settle(amplifier);
    if (timer_sample(&amplifier->intake.life))
        intake_drop(&amplifier->intake);
    if (timer_sample(&amplifier->fed))
        amplifier_fail(amplifier, FAULT_WATCHDOG, NO_CHANNEL);
}

// The voltage u = sqrt((1 + force) / 2): its square is half the full one, the bias, and half the
// force, so that nothing beats and there is no harmonic, whatever the voices play together.
static int16_t voltage_of(int32_t force)
{
    return (int16_t)square_root((uint32_t)(force + INT16_MAX) * INT16_MAX / 2);
}

static int16_t sample_of(int32_t force)
{
    int32_t value = (force + (1 << 14)) >> 15;
    value = value > INT16_MAX ? INT16_MAX : value < -INT16_MAX ? -INT16_MAX : value;
    return SQUARE_LAW ? voltage_of(value) : (int16_t)value;
}

void amplifier_sample(struct amplifier *amplifier, int16_t samples[CHANNELS_MAX])
{
    int32_t forces[CHANNELS_MAX];
    bool is_on = amplifier->high_voltage || !SQUARE_LAW; // without it no bias either
    amplifier_forces(amplifier, forces);
    for (unsigned i = 0; i < CHANNELS; i++)
        samples[i] = is_on ? sample_of(forces[i]) : 0;
}

void amplifier_time(struct amplifier *amplifier, uint64_t now)
{
    if (now > amplifier->now)
        amplifier->now = now;
    amplifier->now_at = amplifier->sample;
    if (timer_is_late(&amplifier->fed, amplifier->now, amplifier->slack))
        amplifier_fail(amplifier, FAULT_WATCHDOG, NO_CHANNEL);
    if (timer_is_late(&amplifier->intake.life, amplifier->now, amplifier->slack))
        intake_drop(&amplifier->intake);
    layers_time(amplifier);
}

uint16_t amplifier_watchdog_left(const struct amplifier *amplifier)
{
    return timer_left(&amplifier->fed, amplifier_now(amplifier));
}
