// SPDX-License-Identifier: MIT
//
// Sets: whether one can be played, staging, tokens, valid_for; and the slots of envelopes.

#include "amplifier.h"

#include <stddef.h>

struct verdict set_add(struct set *set, const struct command *command)
{
    struct verdict bad = {NAK_BAD_CHANNEL, command->channel};
    if (command->channel >= CHANNELS)
        return bad;
    for (unsigned i = 0; i < set->count; i++)
        if (set->commands[i].channel == command->channel)
            return bad;
    set->commands[set->count++] = *command;
    return ACCEPTED;
}

static bool is_same(const struct set *a, const struct set *b)
{
    if (a->token != b->token || a->ramp != b->ramp || a->valid_for != b->valid_for ||
        a->count != b->count)
        return false;
    for (unsigned i = 0; i < a->count; i++) {
        const struct command *c = &a->commands[i], *d = &b->commands[i];
        if (c->channel != d->channel || c->flags != d->flags || c->frequency != d->frequency ||
            c->level != d->level || c->phase != d->phase || c->onset != d->onset ||
            c->ending != d->ending)
            return false;
    }
    return true;
}

static bool is_newer(const struct amplifier *amplifier, uint16_t token)
{
    uint16_t ahead = (uint16_t)(token - amplifier->active.token);
    return token != 0 && (amplifier->active.token == 0 || (ahead >= 1 && ahead <= 32767));
}

static const struct envelope *slot(const struct amplifier *amplifier, uint8_t number)
{
    return number == 0 ? NULL : &amplifier->slots[number - 1];
}

static enum nak check_slot(const struct amplifier *amplifier, uint8_t number)
{
    if (number > ENVELOPE_SLOT_MAX)
        return NAK_BAD_VALUE;
    bool is_empty = number > ENVELOPE_SLOTS || (number > 0 && slot(amplifier, number)->knots == 0);
    return is_empty ? NAK_NO_ENVELOPE : NAK_NONE;
}

static enum nak check_command(const struct amplifier *amplifier, const struct command *command)
{
    bool vibrates = command->level > 0 || command->onset > 0;
    if ((command->flags & ~COMMAND_FLAGS) != 0 || command->level > LEVEL_MAX ||
        command->phase < PHASE_MIN || command->phase > PHASE_MAX)
        return NAK_BAD_VALUE;
    if (vibrates && (command->frequency < FREQUENCY_MIN || command->frequency > FREQUENCY_MAX))
        return NAK_BAD_VALUE;
    enum nak nak = check_slot(amplifier, command->onset);
    return nak != NAK_NONE ? nak : check_slot(amplifier, command->ending);
}

static struct verdict check(const struct amplifier *amplifier, uint16_t session,
                            const struct set *set)
{
    struct verdict verdict = session_check(amplifier, session);
    if (verdict.nak != NAK_NONE)
        return verdict;
    if (!is_newer(amplifier, set->token))
        return refused(NAK_BAD_TOKEN);
    if (set->ramp > RAMP_MAX || set->valid_for > VALID_FOR_MAX)
        return refused(NAK_BAD_VALUE);
    for (unsigned i = 0; i < set->count && verdict.nak == NAK_NONE; i++) {
        verdict.nak = check_command(amplifier, &set->commands[i]);
        if (verdict.nak != NAK_NONE)
            verdict.channel = set->commands[i].channel;
    }
    return verdict;
}

static struct verdict check_room(const struct amplifier *amplifier, const struct set *set)
{
    for (unsigned i = 0; i < set->count; i++) {
        const struct command *command = &set->commands[i];
        if (!channel_has_room(&amplifier->channels[command->channel], command, set->ramp)) {
            struct verdict fading = {NAK_FADING, command->channel};
            return fading;
        }
    }
    return ACCEPTED;
}

// Play a set that was checked; shapes: of each of its commands if it was staged, else null.
static void play(struct amplifier *amplifier, const struct set *set, const struct shapes *shapes)
{
    bool has_command[CHANNELS_MAX] = {false};
    for (unsigned i = 0; i < set->count; i++) {
        const struct command *command = &set->commands[i];
        const struct envelope *onset = slot(amplifier, command->onset);
        const struct envelope *ending = slot(amplifier, command->ending);
        if (shapes != NULL) {
            onset = command->onset ? &shapes[i].onset : NULL;
            ending = command->ending ? &shapes[i].ending : NULL;
        }
        channel_play(&amplifier->channels[command->channel], command, set->ramp, onset, ending);
        has_command[command->channel] = true;
    }
    for (unsigned i = 0; i < CHANNELS; i++)
        if (!has_command[i])
            channel_end(&amplifier->channels[i], set->ramp);
    amplifier->active = *set;
    amplifier->answered = &amplifier->active;
    amplifier->valid_left = (uint32_t)set->valid_for * SAMPLES_PER_MS;
    amplifier->staged_left = 0;
    watchdog_feed(amplifier);
}

struct verdict amplifier_stage(struct amplifier *amplifier, uint16_t session, const struct set *set)
{
    struct verdict verdict = check(amplifier, session, set);
    if (verdict.nak != NAK_NONE)
        return verdict;
    amplifier->staged = *set;
    amplifier->answered = &amplifier->staged;
    amplifier->staged_left = STAGED_LIFE * SAMPLES_PER_MS;
    for (unsigned i = 0; i < set->count; i++) {
        const struct command *command = &set->commands[i];
        if (command->onset)
            amplifier->staged_shapes[i].onset = *slot(amplifier, command->onset);
        if (command->ending)
            amplifier->staged_shapes[i].ending = *slot(amplifier, command->ending);
    }
    watchdog_feed(amplifier);
    return ACCEPTED;
}

// A set that plays already is confirmed, since the reply to the first request was lost.
static struct verdict confirm(struct amplifier *amplifier)
{
    amplifier->answered = &amplifier->active;
    watchdog_feed(amplifier);
    return ACCEPTED;
}

struct verdict amplifier_commit(struct amplifier *amplifier, uint16_t session, uint16_t token)
{
    struct verdict verdict = session_check(amplifier, session);
    if (verdict.nak != NAK_NONE)
        return verdict;
    if (token == 0)
        return refused(NAK_BAD_TOKEN);
    if (token == amplifier->active.token)
        return confirm(amplifier);
    if (amplifier->staged_left == 0 || token != amplifier->staged.token)
        return refused(NAK_BAD_TOKEN);
    verdict = check_room(amplifier, &amplifier->staged);
    if (verdict.nak == NAK_NONE)
        play(amplifier, &amplifier->staged, amplifier->staged_shapes);
    return verdict;
}

struct verdict amplifier_apply(struct amplifier *amplifier, uint16_t session, const struct set *set)
{
    if (session_check(amplifier, session).nak == NAK_NONE && set->token != 0 &&
        is_same(set, &amplifier->active))
        return confirm(amplifier);
    struct verdict verdict = check(amplifier, session, set);
    if (verdict.nak == NAK_NONE)
        verdict = check_room(amplifier, set);
    if (verdict.nak == NAK_NONE)
        play(amplifier, set, NULL);
    return verdict;
}

// One sample's time passes for what waits: the end of a vibration, and a staged set.
void sets_sample(struct amplifier *amplifier)
{
    if (amplifier->valid_left > 0 && --amplifier->valid_left == 0)
        for (unsigned i = 0; i < CHANNELS; i++)
            channel_end(&amplifier->channels[i], amplifier->active.ramp);
    if (amplifier->staged_left > 0)
        amplifier->staged_left--;
}

struct verdict amplifier_load(struct amplifier *amplifier, uint8_t number,
                              const struct envelope *envelope)
{
    if (number < 1 || number > ENVELOPE_SLOTS || envelope->knots > ENVELOPE_KNOTS ||
        envelope->step < ENVELOPE_STEP_MIN || envelope->step > ENVELOPE_STEP_MAX)
        return refused(NAK_BAD_VALUE);
    for (unsigned i = 0; i < envelope->knots; i++)
        if (envelope->knot[i].level > LEVEL_MAX || envelope->knot[i].phase < PHASE_MIN ||
            envelope->knot[i].phase > PHASE_MAX)
            return refused(NAK_BAD_VALUE);
    amplifier->slots[number - 1] = *envelope;
    return ACCEPTED;
}
