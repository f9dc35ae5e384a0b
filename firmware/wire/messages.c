// SPDX-License-Identifier: MIT

#include "messages.h"

#include <string.h>

// One message carries the longest replies of any configuration.
typedef char longest_replies_fit[CAPABILITIES_WORDS(CHANNELS_MAX) <= WORDS_MAX &&
                                 FAULTS_WORDS(FAULTS_KEPT) <= WORDS_MAX ? 1 : -1];

static const struct request {
    bool is_broadcast, feeds, has_tail;
    uint8_t session, fields; // place of the session; how many fields
    struct {
        int32_t low, high;
        enum nak nak;
    } field[REQUEST_FIELDS_MAX];
} REQUESTS[] = {REQUEST_TABLE};

bool message_is_known(uint8_t type)
{
    switch (type) {
    case MESSAGE_SET_ADDRESS:
        return (FEATURES & FEATURE_ADDRESS) != 0;
    case MESSAGE_MARK:
        return (FEATURES & FEATURE_MARK) != 0;
    case MESSAGE_GET_MEASURED:
    case 16: /* reserved, as are 17 and 18 */
    case 17:
    case 18:
        return false;
    default:
        return type >= MESSAGE_GET_CAPS && type < sizeof REQUESTS / sizeof REQUESTS[0];
    }
}

static enum nak check_words(const struct request *request, uint8_t type, const uint16_t *words,
                            uint16_t count)
{
    struct reader reader = reader_of(words, count);
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

static void reply_status(struct words *reply, struct amplifier *amplifier)
{
    uint16_t levels[CHANNELS_MAX], tokens[LAYERS];
    int flags = (amplifier->high_voltage ? FLAG_HIGH_VOLTAGE : 0) |
                (amplifier->measured.is_interlock_open ? FLAG_INTERLOCK_OPEN : 0) |
                (amplifier->is_limited ? FLAG_LIMITED : 0);
    const uint32_t clock = (uint32_t)(amplifier->clock >> 32);
    // Status shows what comes out now, but at once what a request has changed, and a silent state.
    const uint32_t buffered = (uint32_t)(amplifier->ahead > 0 ? amplifier->ahead - 1 : 0) >> 16;
    const uint64_t unchanged = amplifier->sample - amplifier->changed;
    const uint32_t before = unchanged < buffered ? (uint32_t)unchanged : buffered;
    const uint16_t playing = amplifier_layers(amplifier);
    for (unsigned i = 0; i < CHANNELS; i++)
        levels[i] = channel_level(&amplifier->channels[i], amplifier->sample, clock, before);
    for (uint8_t i = 0; i < LAYERS; i++) {
        const struct layer *layer = &amplifier->layers[i];
        bool is_buffered = layer->began + buffered > amplifier->sample;
        uint16_t present_token = playing >> i & 1 ? layer->token : 0;
        tokens[i] = is_buffered ? layer->former_token : present_token;
    }
    struct wire_status status = {
        .state = (uint16_t)amplifier->state,
        .fault = (uint16_t)amplifier->fault,
        .flags = (uint16_t)flags,
        .latch = amplifier->latch,
        .watchdog_left = amplifier_watchdog_left(amplifier),
        .readings = amplifier->measured.readings,
        .clock = amplifier->has_mark ? amplifier->mark : amplifier_clock(amplifier),
        .token = amplifier->committed,
        .channels = CHANNELS,
        .layers = LAYERS,
        .levels = levels,
        .tokens = tokens,
    };
    put_status(reply, &status);
    amplifier->is_limited = amplifier->has_mark = false;
}

static void reply_capabilities(struct words *reply)
{
    struct wire_limit limits[CHANNELS_MAX];
    for (unsigned i = 0; i < CHANNELS; i++) {
        limits[i].frequency_min = FREQUENCY_MIN;
        limits[i].frequency_max = FREQUENCY_MAX;
        limits[i].level_max = LEVEL_MAX;
    }
    struct wire_capabilities capabilities = {
        .channels = CHANNELS,
        .layers = LAYERS,
        .voices = VOICES,
        .set_words = STREAM_WORDS,
        .knots = ENVELOPE_KNOTS,
        .features = FEATURES,
        .frequency_min = FREQUENCY_MIN, .frequency_max = FREQUENCY_MAX, .frequency_step = 1,
        .level_max = LEVEL_MAX, .level_step = 1,
        .phase_step = 1,
        .ramp_max = RAMP_MAX,
        .slew = 0, // no limit
        .watchdog_min = WATCHDOG_MIN, .watchdog_max = WATCHDOG_MAX,
        .envelope_step_min = ENVELOPE_STEP_MIN, .envelope_step_max = ENVELOPE_STEP_MAX,
        .clock_error = CLOCK_ERROR,
        .limits = limits,
    };
    put_capabilities(reply, &capabilities);
}

static void reply_faults(struct words *reply, const struct amplifier *amplifier)
{
    struct wire_fault shown[FAULTS_KEPT];
    struct wire_faults faults = {.count = amplifier->fault_count, .faults = shown};
    for (uint8_t i = 0; i < amplifier->fault_count; i++) {
        uint64_t at = amplifier->faults[i].at; // samples may be made ahead of time
        uint64_t age = amplifier->now > at ? (amplifier->now - at) / 1000 : 0;
        shown[i].fault = amplifier->faults[i].fault;
        shown[i].channel = amplifier->faults[i].channel;
        shown[i].age = age > UINT32_MAX ? UINT32_MAX : (uint32_t)age;
    }
    put_faults(reply, &faults);
}

static enum nak reply_achieved(struct words *reply, const struct amplifier *amplifier,
                               uint16_t number)
{
    if (number >= LAYERS)
        return NAK_BAD_VALUE;
    struct wire_command commands[CHANNELS_MAX];
    struct wire_achieved achieved = {.layer = (uint8_t)number, .commands = commands};
    if (amplifier_layers(amplifier) >> number & 1) {
        achieved.token = amplifier->layers[number].token;
        achieved.ramp = amplifier->layers[number].ramp;
        achieved.valid_for = amplifier->layers[number].valid_for;
    }
    for (uint8_t i = 0; i < CHANNELS; i++) {
        const struct voice *voice = channel_voice(&amplifier->channels[i], (uint8_t)number);
        if (voice == NULL)
            continue;
        commands[achieved.count++] = (struct wire_command){
            .channel = i, .frequency = voice->frequency, .level = voice->level, .phase = voice->phase};
    }
    put_achieved(reply, &achieved);
    return NAK_NONE;
}

// Take a part of a set, and play that where its last part says so.
static struct verdict take(struct amplifier *amplifier, const uint16_t *words, uint16_t count,
                           struct words *reply)
{
    struct intake *intake = &amplifier->intake;
    struct reader part = reader_of(words + SET_STREAM, count - SET_STREAM);
    struct verdict verdict = {.channel = NO_CHANNEL};
    uint16_t token = words[SET_TOKEN], bits = words[SET_BITS];
    bool is_played = token == amplifier->committed, is_staged = false;
    if (!is_played && !is_newer(token, amplifier->committed)) {
        verdict.nak = NAK_BAD_TOKEN;
    } else if (is_earlier_part(bits)) {
        bool is_kept = !is_played && intake_keep(intake, token, bits, &part, amplifier->now);
        verdict.nak = is_kept ? NAK_NONE : NAK_BAD_TOKEN;
        return verdict;
    } else if (!is_played) {
        verdict.nak = intake_take(intake, token, bits, &part, amplifier->now);
        verdict.channel = part.channel;
        is_staged = intake->is_staged && intake->token == token;
    }
    if (verdict.nak != NAK_NONE)
        return verdict;
    if (is_staged && FIELD_OF(bits, SET_NOW)) {
        amplifier_commit(amplifier, (uint16_t)(amplifier_clock(amplifier) >> 16));
        is_played = true;
        is_staged = false;
    }
    struct wire_taken taken = {
        .token = token,
        .exact = is_staged || is_played,
        .staged = is_staged,
        .played = is_played,
        .missing = is_staged || is_played ? 0 : intake_missing(intake, token),
    };
    put_taken(reply, &taken);
    return verdict;
}

static enum nak commit(struct amplifier *amplifier, uint16_t token, uint16_t at)
{
    const struct intake *intake = &amplifier->intake;
    if (token == amplifier->committed) // its reply was lost
        return NAK_NONE;
    if (token != intake->token)
        return NAK_BAD_TOKEN;
    if (!intake->is_staged)
        return NAK_INCOMPLETE;
    amplifier_commit(amplifier, at);
    return NAK_NONE;
}

// Whether a text is this amplifier's serial number.
static enum nak check_name(const struct amplifier *amplifier, const uint16_t *words)
{
    struct words name = {.count = 0};
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
    struct verdict verdict = {.channel = NO_CHANNEL};
    switch (type) {
    case MESSAGE_GET_CAPS:
        reply_capabilities(reply);
        break;
    case MESSAGE_ARM:
        if (words[ARM_WATCHDOG] < WATCHDOG_MIN || words[ARM_WATCHDOG] > WATCHDOG_MAX)
            verdict.nak = NAK_BAD_VALUE;
        else
            amplifier_arm(amplifier, words[ARM_SESSION], words[ARM_WATCHDOG], words[ARM_SHIFT]);
        break;
    case MESSAGE_DISARM:
        amplifier_disarm(amplifier, words[DISARM_RAMP]);
        break;
    case MESSAGE_SET:
        return take(amplifier, words, count, reply);
    case MESSAGE_COMMIT:
        verdict.nak = commit(amplifier, words[COMMIT_TOKEN], words[COMMIT_AT]);
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
        reply_faults(reply, amplifier);
        break;
    case MESSAGE_CLEAR:
        verdict.nak = amplifier_clear(amplifier, words[CLEAR_LATCH]);
        break;
    case MESSAGE_GET_ACHIEVED:
        verdict.nak = reply_achieved(reply, amplifier, words[GET_ACHIEVED_LAYER]);
        break;
    case MESSAGE_SET_ADDRESS:
        verdict.nak = check_name(amplifier, words + SET_ADDRESS_SERIAL_NUMBER);
        break;
    case MESSAGE_PING:
        if (amplifier->state == OPERATION_ENABLED)
            amplifier_steer(amplifier, (int16_t)words[PING_RATE]);
        break;
    case MESSAGE_MARK:
        amplifier->mark = amplifier_clock(amplifier) -
                          (uint32_t)(((uint64_t)amplifier->heard << 32) / (CLOCK_TURN * 1000000));
        amplifier->has_mark = true;
        break;
    default: // GetStatus
        break;
    }
    return verdict;
}

struct verdict message_handle(struct amplifier *amplifier, uint8_t type, const uint16_t *words,
                              uint16_t count, struct words *reply)
{
    struct verdict verdict = {.nak = NAK_UNKNOWN_TYPE, .channel = NO_CHANNEL};
    struct words unsent = {.count = 0};
    bool is_broadcast = reply == NULL;
    if (is_broadcast)
        reply = &unsent;
    reply->count = 0;
    if (!message_is_known(type) || (is_broadcast && !REQUESTS[type].is_broadcast))
        return verdict;
    const struct request *request = &REQUESTS[type];
    verdict.nak = check_words(request, type, words, count);
    if (verdict.nak == NAK_NONE && !is_allowed(amplifier, type))
        verdict.nak = NAK_WRONG_STATE;
    if (verdict.nak == NAK_NONE && request->feeds &&
        is_foreign(amplifier, type, words[request->session]))
        verdict.nak = NAK_WRONG_SESSION;
    if (verdict.nak == NAK_NONE)
        verdict = carry_out(amplifier, type, words, count, reply);
    if (verdict.nak == NAK_NONE && request->feeds)
        amplifier_feed(amplifier);
    if (type == MESSAGE_SET && count > SET_BITS && is_earlier_part(words[SET_BITS]))
        verdict.nak = NAK_NONE; // dropped without a word
    else if (verdict.nak == NAK_NONE && reply->count == 0 && !is_broadcast)
        reply_status(reply, amplifier); // after feeding, so that it shows the watchdog full
    return verdict;
}

void message_nak(struct words *reply, uint8_t type, struct verdict verdict)
{
    struct wire_nak nak = {
        .request = type, .code = (uint16_t)verdict.nak, .channel = verdict.channel};
    reply->count = 0;
    put_nak(reply, &nak);
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
