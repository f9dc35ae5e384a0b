// SPDX-License-Identifier: MIT
//
// Mutated frames for every codec: `era-fuzz COUNT [SEED]`, built with the sanitizers of addresses and
// of undefined behaviour, which end it at the first fault.
//
// A frame begins as one that a host sends, with random values. Some of its bytes are changed, added or
// taken away; then most get a good checksum again, so that they are not stopped there. Between frames
// time passes, so that watchdog, fades and envelopes run. After each frame what every status must
// keep is checked.

#include "amplifier.h"
#include "crc.h"
#include "modbus_rtu.h"
#include "serial.h"
#include "slcan.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define HOST 127 // on CAN

static struct amplifier amplifier;
static uint64_t seed = 1;

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

static void check_amplifier(void)
{
    int16_t samples[CHANNELS];
    for (uint32_t left = any(64) == 0 ? any(20000) : any(200); left > 0; left--)
        amplifier_sample(&amplifier, samples);
    require(amplifier.state >= SWITCH_ON_DISABLED && amplifier.state <= FAULT, "state");
    require(amplifier.state != READY_TO_SWITCH_ON, "state");
    require((amplifier.state == OPERATION_ENABLED) == (amplifier.watchdog_left > 0), "watchdog");
    require((amplifier.state == OPERATION_ENABLED) == (amplifier.session > 0), "session");
    for (unsigned i = 0; i < CHANNELS; i++) {
        uint16_t level = channel_level(&amplifier.channels[i]);
        require(level <= FULL_STROKE, "level");
        require(amplifier.high_voltage || level == 0, "sound without high voltage");
    }
}

static unsigned long mutated;

// Half of all frames stay whole, so that mutated ones meet an amplifier that plays. Of the others
// change, add or take away some bytes; return the new length.
static uint16_t mutate(uint8_t *bytes, uint16_t length, uint16_t longest)
{
    if (any(2))
        return length;
    mutated++;
    for (uint32_t count = 1 + any(3); count > 0; count--) {
        uint16_t at = (uint16_t)any(length + 1u);
        switch (any(4)) {
        case 0:
            if (at < length)
                bytes[at] = (uint8_t)any(256);
            break;
        case 1:
            if (at < length)
                bytes[at] ^= (uint8_t)(1u << any(8));
            break;
        case 2:
            if (length < longest) {
                memmove(bytes + at + 1, bytes + at, length - at);
                bytes[at] = (uint8_t)any(256);
                length++;
            }
            break;
        default:
            if (at < length) {
                memmove(bytes + at, bytes + at + 1, length - at - 1u);
                length--;
            }
        }
    }
    return length;
}

// Mutated frames alone would seldom bring it back to where it plays.
static void arm_again(void)
{
    amplifier_stop(&amplifier, 0);
    amplifier_clear(&amplifier, amplifier.latch);
    amplifier.ended_session = 0;
    amplifier_arm(&amplifier, WATCHDOG_MAX, any(2) ? HOST : (uint16_t)(1 + any(3)));
}

static uint8_t *put_u16(uint8_t *at, uint32_t value)
{
    at[0] = (uint8_t)value;
    at[1] = (uint8_t)(value >> 8);
    return at + 2;
}

static uint32_t some_token(void)
{
    return (amplifier.active.token + any(3)) & 0xFFFF;
}

static uint32_t some_session(void)
{
    return amplifier.state == OPERATION_ENABLED && any(8) ? amplifier.session : any(4);
}

static uint8_t *put_set(uint8_t *at)
{
    uint8_t count = (uint8_t)any(CHANNELS + 2);
    at = put_u16(put_u16(put_u16(at, some_token()), any(1100)), any(4) ? 0 : any(300));
    *at++ = count;
    for (uint8_t i = 0; i < count; i++) {
        *at++ = i;
        *at = (uint8_t)any(8);
        int has_slots = *at++ & 4;
        at = put_u16(put_u16(put_u16(at, 400 + any(4)), any(10001)), any(36000) - 18000u);
        if (has_slots) {
            *at++ = (uint8_t)any(3);
            *at++ = (uint8_t)any(3);
        }
    }
    return at;
}

static uint8_t *put_envelope(uint8_t *at)
{
    uint8_t knots = (uint8_t)any(ENVELOPE_KNOTS + 2);
    *at++ = (uint8_t)(1 + any(3));
    at = put_u16(at, 10 + any(200));
    *at++ = knots;
    for (uint8_t i = 0; i < knots; i++)
        at = put_u16(put_u16(at, any(10001)), any(36000) - 18000u);
    return at;
}

// The serial number of the amplifier.
static uint8_t *put_name(uint8_t *at)
{
    memcpy(at, "FUZZ-1", 6);
    return at + 6;
}

static uint8_t *put_payload(uint8_t *at, uint8_t type)
{
    switch (type) {
    case 3: // Arm
        return put_u16(put_u16(at, 100 + any(1900)), some_session());
    case 5: // Stage
    case 7: // Apply
        return put_set(put_u16(at, some_session()));
    case 6: // Commit
        return put_u16(put_u16(at, some_session()), some_token());
    case 4: // Disarm
    case 8: // Stop
        return put_u16(at, any(100));
    case 11: // Clear
        *at = amplifier.latch;
        return at + 1;
    case 12: // Ping
        return put_u16(at, some_session());
    case 13:
        return put_envelope(at);
    case 15:
        return put_name(put_u16(at, any(4) | 6 << 8));
    default:
        return at;
    }
}

// Requests that arm and play come more often than those that end it.
static uint8_t some_type(void)
{
    static const uint8_t TYPES[] = {1, 2, 3, 3, 3, 4, 5, 5, 6, 6, 7, 7, 7, 7, 8, 9, 10, 11, 11,
                                    12, 12, 13, 13, 14, 15, 30, 31};
    return TYPES[any(sizeof TYPES)];
}

static void fuzz_serial(struct serial *serial)
{
    uint8_t frame[400], line[420];
    uint8_t *at = frame;
    *at++ = some_type();
    *at++ = 2;
    *at++ = any(8) ? 1 : 0;
    at = put_payload(put_u16(at, any(65536)), frame[0]);
    uint16_t length = mutate(frame, (uint16_t)(at - frame), 300), code = 0, out = 1;
    uint32_t crc = any(8) ? crc32_of(frame, length) : any(65536);
    for (int i = 0; i < 4; i++)
        frame[length++] = (uint8_t)(crc >> 8 * i);
    for (uint16_t i = 0; i < length; i++) { // stuffed with COBS
        if (frame[i] != 0 && out - code < 255) {
            line[out++] = frame[i];
            continue;
        }
        line[code] = (uint8_t)(out - code);
        code = out++;
    }
    line[code] = (uint8_t)(out - code);
    line[out++] = 0;
    if (any(8) == 0)
        out = mutate(line, out, sizeof line);
    for (uint16_t i = 0; i < out; i++) {
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

// The registers of a block of the page, from its tag or its first field on; return their number.
static uint16_t put_block(uint8_t *at, uint16_t *address)
{
    static const uint16_t WORDS[] = {15, 15, 15, 0, 2, 128, 1};
    static const uint16_t FIRST[] = {2, 10, 12, 16, 16, 16, 102, 182};
    uint8_t *begin = at;
    uint32_t block = any(8), token = some_token();
    *address = FIRST[block];
    switch (block) {
    case 0:
        at = put_register(put_register(at, WORDS[any(7)]), 100 + any(1900));
        at = put_register(put_register(put_register(at, any(100)), some_session()), amplifier.latch);
        break;
    case 3:
    case 4:
        at = put_register(put_register(at, any(3) ? token : 0), some_session());
        at = put_register(put_register(put_register(at, token), any(100)), any(4) ? 0 : any(300));
        for (uint32_t i = 4 * any(CHANNELS + 1); i > 0; i--)
            at = put_register(at, any(4) ? 400 + any(2) : any(65536) & 0xFC03);
        break;
    case 6: {
        uint32_t knots = any(34);
        at = put_register(put_register(put_register(at, 1 + any(3)), 10 + any(200)), knots);
        for (uint32_t i = 2 * knots; i > 0; i--)
            at = put_register(at, any(10001));
        break;
    }
    case 7:
        memset(at, 0, 34);
        put_name(put_register(at, any(4)));
        at += 34;
        break;
    default:
        at = put_register(at, some_session());
        if (block == 5)
            at = put_register(put_register(begin, token), some_session());
    }
    return (uint16_t)((at - begin) / 2);
}

static void fuzz_modbus(struct rtu *rtu)
{
    static const uint8_t FUNCTIONS[] = {3, 4, 16, 16, 16, 23, 23, 23, 43, 6};
    uint8_t frame[300], *at = frame + 2;
    uint16_t address;
    frame[0] = any(8) ? 1 : 0;
    frame[1] = FUNCTIONS[any(sizeof FUNCTIONS)];
    if (frame[1] == 23)
        at = put_register(put_register(at, any(2) ? 1000 + any(1000) : any(65536)), 1 + any(126));
    if (frame[1] == 16 || frame[1] == 23) {
        uint16_t count = put_block(at + 5, &address);
        at = put_register(put_register(at, address), count);
        *at++ = (uint8_t)(2 * count);
        at += 2 * count;
    } else if (frame[1] == 43) {
        *at++ = 14;
        *at++ = (uint8_t)any(6);
        *at++ = (uint8_t)any(4);
    } else {
        at = put_register(put_register(at, any(2500)), any(130));
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

static void frame_sent(const struct can_frame *frame)
{
    require(frame->length <= 8 && frame->id <= 0x7FF, "frame");
    frames_sent++;
}

static uint64_t some_command(uint8_t channel, uint8_t sequence)
{
    return (400 + any(4)) | (uint64_t)any(10001) << 16 | (uint64_t)any(18000) << 32 |
           (uint64_t)any(8) << 48 | (uint64_t)channel << 52 | (uint64_t)sequence << 56;
}

// The next frame of a host: mostly a set in pieces, of one sequence number for some frames.
static struct can_frame some_frame(uint8_t sequence)
{
    static const uint16_t IDS[] = {0x481, 0x481, 0x481, 0x201, 0x301, 0x401, 0x501, 0x681, 0x681,
                                   0x601, 0x601, 0x601, 0x77F, 0x480, 0x000};
    struct can_frame frame = {IDS[any(sizeof IDS / sizeof IDS[0])], 8, {0}};
    uint64_t data = (uint64_t)any(UINT32_MAX) << 32 | any(UINT32_MAX);
    if (frame.id == 0x481 || frame.id == 0x480) { // an order
        uint32_t action = any(8), first = some_token();
        first = action == 4 ? HOST : action == 7 ? amplifier.latch : first;
        data = first | (uint64_t)any(100) << 16 | (uint64_t)(action == 4 ? 2000 : 0) << 32 |
               (uint64_t)action << 48 | (uint64_t)any(3) << 51 |
               (uint64_t)(frame.id == 0x480 ? 0 : sequence) << 56;
    } else if (frame.id >= 0x201 && frame.id <= 0x501) {
        data = some_command((uint8_t)((frame.id - 0x201) >> 8), sequence);
    } else if (frame.id == 0x681) {
        data = any(3) | (uint64_t)any(3) << 6 | (uint64_t)sequence << 56;
    } else if (frame.id == 0x601 && any(2)) { // objects of the page
        data = (data & ~UINT64_C(0xFFFFFF00)) | (uint64_t)(0x2000 + any(0x40)) << 8;
    } else if (frame.id == 0x77F) {
        frame.length = 1;
    } else if (frame.id == 0x000) { // mostly start
        frame.length = 2;
        data = any(8) ? 1 : 128 + any(3);
    }
    for (unsigned i = 0; i < 8; i++)
        frame.data[i] = (uint8_t)(data >> 8 * i);
    return frame;
}

static void fuzz_can(struct slcan *slcan)
{
    static uint8_t sequence = 1;
    if (slcan->node->consumer == 0) // reset
        slcan->node->consumer = (uint32_t)HOST << 16;
    char line[SLCAN_LINE_MAX + 8];
    if (any(4) == 0)
        sequence = (uint8_t)(1 + sequence % 255);
    struct can_frame frame = some_frame(sequence);
    frame.length = (uint8_t)mutate(frame.data, frame.length, 8);
    uint16_t length = slcan_format(&frame, line);
    if (any(8) == 0)
        length = mutate((uint8_t *)line, length, sizeof line);
    slcan_byte(slcan, 'O');
    slcan_byte(slcan, '\r');
    for (uint16_t i = 0; i < length; i++)
        slcan_byte(slcan, (uint8_t)line[i]);
    can_time(slcan->node);
}

int main(int count, char **arguments)
{
    static struct serial serial;
    static struct modbus modbus;
    static struct rtu rtu;
    static struct can_node node;
    static struct slcan slcan;
    unsigned long played[3] = {0, 0, 0}, frames = count > 1 ? strtoul(arguments[1], NULL, 10) : 20000;
    if (count > 2)
        seed = strtoull(arguments[2], NULL, 10);
    amplifier_init(&amplifier, "FUZZ-1");
    serial_init(&serial, &amplifier, 1);
    modbus_init(&modbus, &amplifier, 1);
    rtu_init(&rtu, &modbus);
    can_init(&node, &amplifier, 1, frame_sent);
    slcan_init(&slcan, &node);
    for (int codec = 0; codec < 3; codec++) {
        for (mutated = 0; mutated < frames;) {
            if (amplifier.state != OPERATION_ENABLED && any(4) == 0)
                arm_again();
            uint16_t token = amplifier.active.token;
            serial.address = modbus.unit = node.next_number = 1; // a SetAddress may have moved them
            if (codec == 0)
                fuzz_serial(&serial);
            else if (codec == 1)
                fuzz_modbus(&rtu);
            else
                fuzz_can(&slcan);
            played[codec] += amplifier.active.token != token && amplifier.active.token != 0;
            check_amplifier();
        }
    }
    printf("%lu mutated frames for each codec, and as many whole ones:\n"
           "  serial discarded %lu, and played %lu sets\n"
           "  Modbus discarded %lu, and played %lu sets\n"
           "  CAN sent %lu frames, and played %lu sets\n",
           frames, (unsigned long)serial.discarded, played[0], (unsigned long)rtu.discarded,
           played[1], frames_sent, played[2]);
    return 0;
}
