// SPDX-License-Identifier: MIT

#include "messages.h"

#include <string.h>

#define FIELDS_MAX 3

static const struct request {
    bool is_broadcast, feeds, has_tail;
    uint8_t fields;
    struct {
        int32_t low, high;
        enum nak nak;
    } field[FIELDS_MAX];
} REQUESTS[] = {REQUEST_TABLE};

static const struct request *request_of(uint8_t type)
{
    bool is_known = type >= MESSAGE_GET_CAPS && type < sizeof REQUESTS / sizeof REQUESTS[0];
    return is_known ? &REQUESTS[type] : NULL;
}

bool message_is_broadcast(uint8_t type)
{
    const struct request *request = request_of(type);
    return request != NULL && request->is_broadcast;
}

static bool is_there(uint8_t type)
{
    switch (type) {
    case MESSAGE_SET_ADDRESS:
        return (FEATURES & FEATURE_ADDRESS) != 0;
    case MESSAGE_GET_MEASURED:
    case MESSAGE_GET_SENSORS:
    case MESSAGE_MEASURE:
    case MESSAGE_GET_READING:
        return false;
    default:
        return true;
    }
}

static enum nak check_words(const struct request *request, uint8_t type, const uint16_t *words,
                            uint16_t count)
{
    struct reader reader = {words, count, NAK_NONE, NO_CHANNEL};
    for (uint8_t i = 0; i < request->fields; i++)
        read_word(&reader, request->field[i].low, request->field[i].high, request->field[i].nak);
    bool is_text = reader.left > 0 && *reader.at <= SERIAL_NUMBER_MAX &&
                   reader.left == 1 + (*reader.at + 1) / 2;
    if (type == MESSAGE_SET_ADDRESS ? !is_text : reader.left > 0 && !request->has_tail)
        reader_refuse(&reader, NAK_BAD_LENGTH, NO_CHANNEL);
    return reader.nak;
}

static bool is_allowed(const struct amplifier *amplifier, uint8_t type)
{
    switch (type) {
    case MESSAGE_ARM:
        return amplifier->state >= SWITCH_ON_DISABLED && amplifier->state <= OPERATION_ENABLED &&
               !amplifier->measured.is_interlock_open;
    case MESSAGE_SET:
    case MESSAGE_COMMIT:
    case MESSAGE_SILENCE:
        return amplifier->state == OPERATION_ENABLED;
    case MESSAGE_SET_ADDRESS:
        return amplifier->state == SWITCH_ON_DISABLED;
    default:
        return true;
    }
}

// Whether a session is not the one that is held or, to arm, has ended.
static bool is_foreign(const struct amplifier *amplifier, uint8_t type, uint16_t session)
{
    if (amplifier->state == OPERATION_ENABLED)
        return session != amplifier->session;
    return type == MESSAGE_ARM && session == amplifier->session;
}

static void put_status(struct words *reply, struct amplifier *amplifier)
{
    uint16_t *words = reply->words;
    int flags = (amplifier->high_voltage ? FLAG_HIGH_VOLTAGE : 0) |
                (amplifier->measured.is_interlock_open ? FLAG_INTERLOCK_OPEN : 0) |
                (amplifier->is_limited ? FLAG_LIMITED : 0);
    amplifier->is_limited = false;
    words[STATUS_STATE] = (uint16_t)amplifier->state;
    words[STATUS_FAULT] = (uint16_t)amplifier->fault;
    words[STATUS_FLAGS] = (uint16_t)flags;
    words[STATUS_LATCH] = amplifier->latch;
    words[STATUS_WATCHDOG_LEFT] = amplifier_watchdog_left(amplifier);
    words[STATUS_TEMPERATURE] = (uint16_t)amplifier->measured.temperature;
    words[STATUS_HIGH_VOLTAGE] = amplifier->measured.voltage;
    words[STATUS_TOKEN] = amplifier->committed;
    words[STATUS_BITS] = (uint16_t)(CHANNELS << STATUS_CHANNELS_SHIFT | LAYERS);
    reply->count = STATUS_WORDS;
    for (unsigned i = 0; i < CHANNELS; i++)
        put(reply, channel_level(&amplifier->channels[i]));
    for (uint8_t i = 0; i < LAYERS; i++)
        put(reply, amplifier_token(amplifier, i));
}

static void put_capabilities(struct words *reply)
{
    uint16_t *words = reply->words;
    words[CAPABILITIES_CHANNELS] = CHANNELS;
    words[CAPABILITIES_LAYERS] = LAYERS;
    words[CAPABILITIES_VOICES] = VOICES;
    words[CAPABILITIES_SET_WORDS] = STREAM_WORDS;
    words[CAPABILITIES_KNOTS] = ENVELOPE_KNOTS;
    words[CAPABILITIES_FEATURES] = FEATURES;
    words[CAPABILITIES_FREQUENCY_MIN] = FREQUENCY_MIN;
    words[CAPABILITIES_FREQUENCY_MAX] = FREQUENCY_MAX;
    words[CAPABILITIES_FREQUENCY_STEP] = 1;
    words[CAPABILITIES_LEVEL_MAX] = LEVEL_MAX;
    words[CAPABILITIES_LEVEL_STEP] = 1;
    words[CAPABILITIES_PHASE_STEP] = 1;
    words[CAPABILITIES_RAMP_MAX] = RAMP_MAX;
    words[CAPABILITIES_SLEW] = UINT16_MAX;
    words[CAPABILITIES_WATCHDOG_MIN] = WATCHDOG_MIN;
    words[CAPABILITIES_WATCHDOG_MAX] = WATCHDOG_MAX;
    words[CAPABILITIES_ENVELOPE_STEP_MIN] = ENVELOPE_STEP_MIN;
    words[CAPABILITIES_ENVELOPE_STEP_MAX] = ENVELOPE_STEP_MAX;
    reply->count = CAPABILITIES_WORDS;
    for (unsigned i = 0; i < CHANNELS; i++) {
        put(reply, FREQUENCY_MIN);
        put(reply, FREQUENCY_MAX);
        put(reply, LEVEL_MAX);
    }
}

static void put_faults(struct words *reply, const struct amplifier *amplifier)
{
    put(reply, amplifier->fault_count);
    for (uint8_t i = 0; i < amplifier->fault_count; i++) {
        uint64_t at = amplifier->faults[i].at; // samples may be made ahead of time
        uint64_t age = amplifier->now > at ? (amplifier->now - at) / 1000 : 0;
        uint32_t shown = age > UINT32_MAX ? UINT32_MAX : (uint32_t)age;
        put(reply, amplifier->faults[i].fault);
        put(reply, amplifier->faults[i].channel);
        put(reply, (uint16_t)(shown >> 16));
        put(reply, (uint16_t)shown);
    }
}

static enum nak put_achieved(struct words *reply, const struct amplifier *amplifier, uint16_t number)
{
    if (number >= LAYERS)
        return NAK_BAD_VALUE;
    const struct layer *layer = &amplifier->layers[number];
    uint16_t token = amplifier_token(amplifier, (uint8_t)number), count = 0;
    reply->words[ACHIEVED_TOKEN] = token;
    reply->words[ACHIEVED_RAMP] = token > 0 ? layer->ramp : 0;
    reply->words[ACHIEVED_VALID_FOR] = token > 0 ? layer->valid_for : 0;
    reply->count = ACHIEVED_WORDS;
    for (unsigned i = 0; i < CHANNELS; i++) {
        const struct voice *voice = channel_voice(&amplifier->channels[i], (uint8_t)number);
        if (voice == NULL)
            continue;
        put(reply, (uint16_t)(i << COMMAND_CHANNEL_SHIFT));
        put(reply, voice->frequency);
        put(reply, voice->level);
        put(reply, (uint16_t)voice->phase);
        count++;
    }
    reply->words[ACHIEVED_BITS] = (uint16_t)(number << ACHIEVED_LAYER_SHIFT | count);
    return NAK_NONE;
}

// Take a part of a set, and play it where it is whole and says so.
static struct verdict take(struct amplifier *amplifier, const uint16_t *words, uint16_t count,
                           struct words *reply)
{
    struct intake *intake = &amplifier->intake;
    struct reader part = {words + SET_STREAM, (uint16_t)(count - SET_STREAM), NAK_NONE, NO_CHANNEL};
    struct verdict verdict = {NAK_NONE, NO_CHANNEL};
    uint16_t token = words[SET_TOKEN], bits = words[SET_BITS];
    bool is_played = token == amplifier->committed, is_staged = false;
    if (!is_played) {
        verdict.nak = is_newer(token, amplifier->committed)
                          ? intake_take(intake, token, bits, &part, amplifier->now)
                          : NAK_BAD_TOKEN;
        verdict.channel = part.channel;
        is_staged = intake->is_staged;
    }
    if (verdict.nak != NAK_NONE)
        return verdict;
    if (is_staged && FIELD_OF(bits, SET_NOW)) {
        amplifier_play(amplifier);
        is_played = true;
        is_staged = false;
    }
    put(reply, token);
    put(reply, (uint16_t)(1 << TAKEN_EXACT_SHIFT | is_staged << TAKEN_STAGED_SHIFT |
                          is_played << TAKEN_PLAYED_SHIFT));
    put(reply, is_staged || is_played ? 0 : intake_missing(intake));
    return verdict;
}

static enum nak commit(struct amplifier *amplifier, uint16_t token)
{
    const struct intake *intake = &amplifier->intake;
    if (token == amplifier->committed) // its reply was lost
        return NAK_NONE;
    if (token != intake->token)
        return NAK_BAD_TOKEN;
    if (!intake->is_staged)
        return NAK_INCOMPLETE;
    amplifier_play(amplifier);
    return NAK_NONE;
}

// Whether a text is this amplifier's serial number.
static enum nak check_name(const struct amplifier *amplifier, const uint16_t *words)
{
    struct words name = {0};
    put_text(&name, amplifier->serial_number);
    uint16_t whole = (uint16_t)(1 + words[0] / 2); // what is behind an odd text has no meaning
    bool is_same = words[0] == name.words[0] && memcmp(words, name.words, whole * sizeof *words) == 0;
    if (is_same && words[0] % 2 == 1)
        is_same = words[whole] >> 8 == name.words[whole] >> 8;
    return is_same ? NAK_NONE : NAK_BAD_VALUE;
}

static struct verdict carry_out(struct amplifier *amplifier, uint8_t type, const uint16_t *words,
                                uint16_t count, struct words *reply)
{
    struct verdict verdict = {NAK_NONE, NO_CHANNEL};
    switch (type) {
    case MESSAGE_GET_CAPS:
        put_capabilities(reply);
        break;
    case MESSAGE_ARM:
        if (words[ARM_WATCHDOG] < WATCHDOG_MIN || words[ARM_WATCHDOG] > WATCHDOG_MAX)
            verdict.nak = NAK_BAD_VALUE;
        else
            amplifier_arm(amplifier, words[ARM_SESSION], words[ARM_WATCHDOG]);
        break;
    case MESSAGE_DISARM:
        amplifier_disarm(amplifier, words[DISARM_RAMP]);
        break;
    case MESSAGE_SET:
        return take(amplifier, words, count, reply);
    case MESSAGE_COMMIT:
        verdict.nak = commit(amplifier, words[COMMIT_TOKEN]);
        break;
    case MESSAGE_SILENCE:
        if (words[SILENCE_RAMP] > RAMP_MAX)
            verdict.nak = NAK_BAD_VALUE;
        else
            amplifier_silence(amplifier, words[SILENCE_RAMP]);
        break;
    case MESSAGE_STOP:
        amplifier_stop(amplifier, words[STOP_RAMP]);
        break;
    case MESSAGE_GET_FAULTS:
        put_faults(reply, amplifier);
        break;
    case MESSAGE_CLEAR:
        verdict.nak = amplifier_clear(amplifier, words[CLEAR_LATCH]);
        break;
    case MESSAGE_GET_ACHIEVED:
        verdict.nak = put_achieved(reply, amplifier, words[GET_ACHIEVED_LAYER]);
        break;
    case MESSAGE_SET_ADDRESS:
        verdict.nak = check_name(amplifier, words + SET_ADDRESS_SERIAL_NUMBER);
        break;
    default: // GetStatus and Ping
        break;
    }
    return verdict;
}

struct verdict message_handle(struct amplifier *amplifier, uint8_t type, const uint16_t *words,
                              uint16_t count, struct words *reply)
{
    const struct request *request = request_of(type);
    struct verdict verdict = {NAK_UNKNOWN_TYPE, NO_CHANNEL};
    reply->count = 0;
    if (request == NULL || !is_there(type))
        return verdict;
    verdict.nak = check_words(request, type, words, count);
    if (verdict.nak == NAK_NONE && !is_allowed(amplifier, type))
        verdict.nak = NAK_WRONG_STATE;
    if (verdict.nak == NAK_NONE && request->feeds && is_foreign(amplifier, type, words[0]))
        verdict.nak = NAK_WRONG_SESSION;
    if (verdict.nak == NAK_NONE)
        verdict = carry_out(amplifier, type, words, count, reply);
    if (verdict.nak != NAK_NONE)
        return verdict;
    if (request->feeds)
        amplifier_feed(amplifier);
    if (reply->count == 0) // after feeding, so that the status shows the watchdog full
        put_status(reply, amplifier);
    return verdict;
}

void message_nak(struct words *reply, uint8_t type, struct verdict verdict)
{
    reply->count = NAK_WORDS;
    reply->words[NAK_REQUEST] = type;
    reply->words[NAK_CODE] = (uint16_t)verdict.nak;
    reply->words[NAK_CHANNEL] = verdict.channel;
}

const char *message_text(const struct amplifier *amplifier, unsigned number)
{
    const char *const texts[TEXTS] = {VENDOR, PRODUCT, amplifier->serial_number, FIRMWARE_VERSION};
    return texts[number];
}

void message_identity(struct words *reply, const struct amplifier *amplifier)
{
    put(reply, 1 << PROTOCOL_VERSION);
    for (unsigned i = 0; i < TEXTS; i++)
        put_text(reply, message_text(amplifier, i));
}
