// SPDX-License-Identifier: MIT

#include "slcan.h"

#include <stddef.h>
#include <string.h>

#define OK "\r"
#define ERROR "\a"

void slcan_init(struct slcan *slcan, struct can_node *node)
{
    memset(slcan, 0, sizeof *slcan);
    slcan->node = node;
}

static int digit(char character)
{
    if (character >= '0' && character <= '9')
        return character - '0';
    if (character >= 'A' && character <= 'F')
        return character - 'A' + 10;
    if (character >= 'a' && character <= 'f')
        return character - 'a' + 10;
    return -1;
}

// A number of so many hexadecimal digits, or -1.
static int number(const char *text, unsigned digits)
{
    int value = 0;
    while (digits-- > 0) {
        int next = digit(*text++);
        if (next < 0)
            return -1;
        value = value << 4 | next;
    }
    return value;
}

// A data frame with an 11-bit identifier: tIIILDD...
static bool transmit(struct slcan *slcan)
{
    struct can_frame frame = {.length = 0};
    int id = slcan->length >= 5 ? number(slcan->line + 1, 3) : -1;
    int length = slcan->length >= 5 ? number(slcan->line + 4, 1) : -1;
    if (!slcan->is_open || id < 0 || id > 0x7FF || length < 0 || length > 8 ||
        slcan->length != 5 + 2 * length)
        return false;
    frame.id = (uint16_t)id;
    frame.length = (uint8_t)length;
    for (int i = 0; i < length; i++) {
        int byte = number(slcan->line + 5 + 2 * i, 2);
        if (byte < 0)
            return false;
        frame.data[i] = (uint8_t)byte;
    }
    can_receive(slcan->node, &frame);
    return true;
}

static const char *line_received(struct slcan *slcan)
{
    switch (slcan->line[0]) {
    case 'O': // open
    case 'L': // open to listen
        slcan->is_open = true;
        return OK;
    case 'C':
        slcan->is_open = false;
        return OK;
    case 'S': // bit rate, which has no meaning here
    case 's':
    case 'Z': // time stamps: none
        return OK;
    case 'V':
        return "V1010\r";
    case 'N':
        return "NERA1\r";
    case 'F': // no errors
        return "F00\r";
    case 't':
        return transmit(slcan) ? OK : ERROR;
    case 'T': // extended and remote frames: nothing here receives them
    case 'r':
    case 'R':
        return OK;
    default:
        return ERROR;
    }
}

const char *slcan_byte(struct slcan *slcan, uint8_t byte)
{
    const char *answer = NULL;
    if (byte != '\r') {
        if (slcan->length == SLCAN_LINE_MAX)
            slcan->is_overlong = true;
        else
            slcan->line[slcan->length++] = (char)byte;
        return NULL;
    }
    if (slcan->is_overlong)
        answer = ERROR;
    else if (slcan->length > 0)
        answer = line_received(slcan);
    slcan->length = 0;
    slcan->is_overlong = false;
    return answer;
}

uint16_t slcan_format(const struct can_frame *frame, char line[SLCAN_LINE_MAX])
{
    static const char DIGITS[] = "0123456789ABCDEF";
    uint16_t at = 0;
    line[at++] = 't';
    for (int shift = 8; shift >= 0; shift -= 4)
        line[at++] = DIGITS[frame->id >> shift & 15];
    line[at++] = DIGITS[frame->length];
    for (unsigned i = 0; i < frame->length; i++) {
        line[at++] = DIGITS[frame->data[i] >> 4];
        line[at++] = DIGITS[frame->data[i] & 15];
    }
    line[at++] = '\r';
    return at;
}
