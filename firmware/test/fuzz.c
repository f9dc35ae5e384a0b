// SPDX-License-Identifier: MIT
//
// Mutated frames for every codec: `era-fuzz COUNT [SEED]`, built with the sanitizers of addresses and
// of undefined behaviour, which end it at the first fault.
//
// A frame begins as one that a host sends, with random words. Some of its bytes are changed, added or
// taken away; then nearly all get a good checksum again, so that they are not stopped there. Between
// frames time passes, so that watchdog, fades and envelopes run. After each frame what every status
// must keep is checked.

#include "crc.h"
#include "messages.h"
#include "modbus_rtu.h"
#include "serial.h"
#include "slcan.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static struct amplifier amplifier;
static uint64_t seed;
static unsigned long mutated, events;

static uint32_t any(uint32_t below)
{
    seed ^= seed << 13;
    seed ^= seed >> 7;
    seed ^= seed << 17;
    return (uint32_t)(seed >> 32) % below;
}

static void require(int condition, const char *what)
{
    if (!condition) {
        fprintf(stderr, "era-fuzz: %s\n", what);
        abort();
    }
}

static void notify(const struct amplifier *changed, const struct words *event)
{
    require(changed == &amplifier && event->count == EVENT_WORDS, "event");
    events++;
}

static void check_amplifier(void)
{
    int16_t samples[CHANNELS];
    uint32_t passed = any(64) == 0 ? any(5000) : any(100);
    for (uint32_t left = passed; left > 0; left--)
        amplifier_sample(&amplifier, samples);
    amplifier_time(&amplifier, amplifier.now + (any(256) ? passed * 125 / 2 : any(3000000)));
    bool is_armed = amplifier.state == OPERATION_ENABLED;
    require(amplifier.state >= SWITCH_ON_DISABLED && amplifier.state <= FAULT, "state");
    require(amplifier.state != READY_TO_SWITCH_ON, "state");
    require(is_armed == (amplifier.fed.samples > 0), "watchdog");
    require(!is_armed || amplifier.session > 0, "session");
    require(amplifier.intake.count <= STREAM_WORDS, "set");
    for (unsigned i = 0; i < CHANNELS; i++) {
        unsigned lasting = 0;
        for (unsigned j = 0; j < VOICES_KEPT; j++)
            lasting += amplifier.channels[i].voices[j].is_playing &&
                       voice_outlasts(&amplifier.channels[i].voices[j], SHORTENED_FADE_MS);
        require(lasting <= VOICES, "voices");
        uint16_t level = channel_level(&amplifier.channels[i]);
        require(level <= LEVEL_MAX, "level");
        require(amplifier.high_voltage || level == 0, "level without high voltage");
    }
}

// Half of all frames stay whole, so that mutated ones meet an amplifier that plays. Of the others
// change, add or take away some bytes; return the new length.
static uint16_t mutate(uint8_t *bytes, uint16_t length, uint16_t length_max)
{
    if (any(2))
        return length;
    mutated++;
    for (uint32_t count = 1 + any(3); count > 0; count--) {
        uint16_t at = (uint16_t)any(length + 1u);
        uint32_t what = any(4);
        if (what < 2 && at < length) {
            bytes[at] ^= (uint8_t)(what == 0 ? any(256) : 1u << any(8));
        } else if (what == 2 && length < length_max) {
            memmove(bytes + at + 1, bytes + at, length - at);
            bytes[at] = (uint8_t)any(256);
            length++;
        } else if (what == 3 && at < length) {
            memmove(bytes + at, bytes + at + 1, length - at - 1u);
            length--;
        }
    }
    return length;
}

// Mutated frames alone would seldom bring it back to where it plays.
static void arm_again(void)
{
    struct words reply;
    uint16_t session = (uint16_t)(1 + amplifier.session % 3), watchdog = 300;
    uint16_t arm[ARM_WORDS] = {session, watchdog};
    amplifier_stop(&amplifier, 0);
    amplifier_clear(&amplifier, amplifier.latch);
    message_handle(&amplifier, MESSAGE_ARM, arm, ARM_WORDS, &reply);
}

static uint16_t some_phase(void)
{
    return (uint16_t)(any(36000) - 18000u);
}

static void put_envelope(struct words *words)
{
    uint16_t knots = (uint16_t)(any(8) ? any(4) : any(ENVELOPE_KNOTS + 2));
    put(words, knots);
    put(words, (uint16_t)(9 + any(200)));
    for (; knots > 0; knots--) {
        put(words, (uint16_t)any(10001));
        put(words, some_phase());
    }
}

static void put_layer(struct words *words)
{
    uint32_t count = any(CHANNELS + 1), flags = any(8) ? 0 : any(4);
    put(words, (uint16_t)(any(LAYERS) << LAYER_LAYER_SHIFT | flags << LAYER_RENEW_SHIFT | count));
    put(words, (uint16_t)any(100));
    put(words, (uint16_t)(any(4) ? 0 : any(300)));
    for (uint32_t i = 0; i < count; i++) {
        uint32_t bits = any(4) ? 4 * any(4) : any(16);
        put(words, (uint16_t)(i << COMMAND_CHANNEL_SHIFT | bits));
        put(words, (uint16_t)(400 + any(4)));
        put(words, (uint16_t)any(3000));
        put(words, some_phase());
        if (FIELD_OF(bits, COMMAND_ONSET))
            put_envelope(words);
        if (FIELD_OF(bits, COMMAND_ENDING))
            put_envelope(words);
    }
}

// The next request of a host; return its type. Those that arm and play come more often.
static uint8_t some_request(struct words *words)
{
    static const uint8_t TYPES[] = {1, 2, 3, 4, 5, 5, 5, 5, 5, 5, 5, 6, 6, 6, 7, 8, 9, 10,
                                    11, 12, 12, 13, 14, 15, 16, 17, 18, 30, 31};
    uint8_t type = TYPES[any(sizeof TYPES)];
    bool is_longer = any(16) == 0;
    words->count = 0;
    if (type == MESSAGE_ARM || (type >= MESSAGE_SET && type <= MESSAGE_SILENCE) ||
        type == MESSAGE_PING)
        put(words, any(16) ? amplifier.session : (uint16_t)any(4));
    if (type == MESSAGE_SET || type == MESSAGE_COMMIT)
        put(words, (uint16_t)(amplifier.committed + (any(4) ? 1 : any(3))));
    if (type == MESSAGE_SET) {
        uint32_t parts = any(4) ? 1 : 1 + any(4);
        put(words, (uint16_t)(any(parts) << SET_INDEX_SHIFT | parts << SET_PARTS_SHIFT | (any(4) > 0)));
        for (uint32_t layers = any(4); layers > 0; layers--)
            put_layer(words);
    } else if (type == MESSAGE_ARM) {
        put(words, (uint16_t)(100 + any(1900)));
    } else if (type == MESSAGE_DISARM || type == MESSAGE_SILENCE || type == MESSAGE_STOP) {
        put(words, (uint16_t)any(100));
    } else if (type == MESSAGE_CLEAR) {
        put(words, amplifier.latch);
    } else if (type == MESSAGE_GET_ACHIEVED) {
        put(words, (uint16_t)any(LAYERS + 1));
    } else if (type == MESSAGE_SET_ADDRESS) {
        put(words, (uint16_t)any(4));
        put_text(words, amplifier.serial_number);
    }
    if (is_longer)
        put(words, (uint16_t)any(65536));
    return type;
}

static void fuzz_serial(struct serial *serial)
{
    uint8_t frame[400] = {0}, line[420];
    struct words words;
    uint16_t length = SERIAL_HEADER;
    frame[0] = some_request(&words);
    frame[1] = any(32) ? PROTOCOL_VERSION : (uint8_t)any(4);
    frame[2] = any(8) ? 1 : 0;
    for (uint16_t i = 0; i < words.count; i++) {
        frame[length++] = (uint8_t)words.words[i];
        frame[length++] = (uint8_t)(words.words[i] >> 8);
    }
    length = serial_finish(frame, mutate(frame, length, 300), line);
    if (any(8) == 0)
        length = mutate(line, length, sizeof line);
    for (uint16_t i = 0; i < length; i++) {
        uint16_t size = serial_byte(serial, line[i]);
        require(size == 0 || (size >= 12 && size <= SERIAL_STUFFED_MAX + 2), "size of a reply");
    }
}

static uint8_t *put_register(uint8_t *at, uint32_t value)
{
    at[0] = (uint8_t)(value >> 8);
    at[1] = (uint8_t)value;
    return at + 2;
}

static void fuzz_modbus(struct rtu *rtu)
{
    static const uint8_t FUNCTIONS[] = {3, 4, 16, 16, 16, 16, 43, 6};
    uint8_t frame[300], *at = frame + 2;
    struct words words;
    frame[0] = any(8) ? 1 : 0;
    frame[1] = FUNCTIONS[any(sizeof FUNCTIONS)];
    if (frame[1] == 16) {
        uint8_t type = some_request(&words);
        at = put_register(put_register(at, type * 256u), words.count + 1u);
        *at++ = (uint8_t)(2 * words.count + 2);
        at = put_register(at, any(65536));
        for (uint16_t i = 0; i < words.count; i++)
            at = put_register(at, words.words[i]);
    } else {
        uint32_t address = any(4) ? any(20) * 256 + 128 : any(2) ? 1065 + any(70) : any(65536);
        at = put_register(put_register(at, address), any(130));
    }
    uint16_t length = mutate(frame, (uint16_t)(at - frame), 254);
    uint16_t crc = any(8) ? crc16_of(frame, length) : (uint16_t)any(65536);
    frame[length++] = (uint8_t)crc;
    frame[length++] = (uint8_t)(crc >> 8);
    for (uint16_t i = 0; i < length; i++)
        rtu_byte(rtu, frame[i]);
    uint16_t size = rtu_silence(rtu, any(8) ? RTU_SILENCE : RTU_LONGEST_PAUSE);
    require(size == 0 || (size >= 5 && size <= RTU_FRAME_MAX), "size of a reply");
}

static unsigned long frames_sent;
static struct slcan *slcan_under_test;
static struct can_frame outgoing[SEGMENTS_MAX + 1];
static unsigned outgoing_count;

static void frame_sent(const struct can_frame *frame)
{
    require(frame->length <= 8 && frame->id <= 0x7FF, "frame");
    frames_sent++;
}

static void frame_queued(const struct can_frame *frame)
{
    require(outgoing_count <= SEGMENTS_MAX, "frames");
    outgoing[outgoing_count++] = *frame;
}

static void send_line(struct can_frame frame, bool may_mutate)
{
    char line[SLCAN_LINE_MAX + 8];
    if (may_mutate)
        frame.length = (uint8_t)mutate(frame.data, frame.length, 8);
    uint16_t length = slcan_format(&frame, line);
    if (may_mutate && any(4) == 0)
        length = mutate((uint8_t *)line, length, sizeof line);
    for (uint16_t i = 0; i < length; i++)
        slcan_byte(slcan_under_test, (uint8_t)line[i]);
}

// A request in frames of a host, or a frame to the objects or of network management.
static void fuzz_can(struct slcan *slcan)
{
    static struct can_node host; // its frames become those of a host
    static uint8_t number = 1;
    struct words words;
    slcan_under_test = slcan;
    slcan_byte(slcan, 'O');
    slcan_byte(slcan, '\r');
    if (any(4) == 0) {
        static const uint16_t IDS[] = {0x000, 0x000, 0x601, 0x601, 0x601, 0x601, 0x701};
        struct can_frame frame = {IDS[any(sizeof IDS / sizeof IDS[0])], 8, {0}};
        for (unsigned i = 0; i < 8; i++)
            frame.data[i] = (uint8_t)any(256);
        if (frame.id == 0) { // mostly start
            frame.length = 2;
            frame.data[0] = any(8) ? 1 : (uint8_t)(128 + any(3));
            frame.data[1] = 0;
        } else if (any(2)) { // objects that there are
            frame.data[1] = (uint8_t)any(4);
            frame.data[2] = 0x20;
            frame.data[3] = (uint8_t)any(32);
        }
        send_line(frame, true);
    } else {
        uint8_t type = some_request(&words);
        bool is_broadcast = any(8) == 0;
        number = (uint8_t)(any(16) ? 1u + number % 255u : any(256));
        host.send = frame_queued;
        host.number = is_broadcast ? 0 : 1;
        outgoing_count = 0;
        bool may_mutate = any(2);
        can_send_message(&host, is_broadcast ? 0 : number, type, &words);
        for (unsigned i = 0; i < outgoing_count; i++) {
            struct can_frame *frame = &outgoing[any(32) ? i : any(outgoing_count)];
            frame->id = (uint16_t)(0x200 + host.number);
            send_line(*frame, may_mutate && any(4) == 0);
        }
    }
    can_time(slcan->node);
}

int main(int count, char **arguments)
{
    static struct serial serial;
    static struct modbus modbus;
    static struct rtu rtu;
    static struct can_node node;
    static struct slcan slcan;
    unsigned long played[3] = {0}, frames = count > 1 ? strtoul(arguments[1], NULL, 10) : 20000;
    seed = count > 2 ? strtoull(arguments[2], NULL, 10) : 1;
    amplifier_init(&amplifier, "FUZZ-1", notify);
    serial_init(&serial, &amplifier, 1);
    modbus_init(&modbus, &amplifier, 1);
    rtu_init(&rtu, &modbus);
    can_init(&node, &amplifier, 1, frame_sent);
    slcan_init(&slcan, &node);
    for (int codec = 0; codec < 3; codec++) {
        for (mutated = 0; mutated < frames;) {
            if (amplifier.state != OPERATION_ENABLED && any(4) == 0)
                arm_again();
            uint16_t token = amplifier.committed;
            serial.address = modbus.unit = node.number = 1; // a SetAddress may have moved them
            if (codec == 0)
                fuzz_serial(&serial);
            else if (codec == 1)
                fuzz_modbus(&rtu);
            else
                fuzz_can(&slcan);
            played[codec] += amplifier.committed != token && amplifier.committed != 0;
            check_amplifier();
        }
    }
    printf("%lu mutated frames for each codec, and as many whole ones; %lu events:\n"
           "  serial discarded %lu, and played %lu sets\n"
           "  Modbus discarded %lu, and played %lu sets\n"
           "  CAN sent %lu frames, and played %lu sets\n",
           frames, events, (unsigned long)serial.discarded, played[0],
           (unsigned long)rtu.discarded, played[1], frames_sent, played[2]);
    return 0;
}
