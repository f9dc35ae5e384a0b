// SPDX-License-Identifier: MIT
//
// The SDO server of CiA 301: expedited and segmented transfers, one at a time.

#include "can.h"

#include <string.h>

#define SDO_REPLY 0x580

// Command specifiers: of the client, in the highest three bits of the first byte.
enum client { DOWNLOAD_SEGMENT = 0, DOWNLOAD = 1, UPLOAD = 2, UPLOAD_SEGMENT = 3, ABORT = 4 };

#define UPLOAD_REPLY 0x40
#define DOWNLOAD_REPLY 0x60
#define DOWNLOAD_SEGMENT_REPLY 0x20
#define ABORT_REPLY 0x80
#define TOGGLE 0x10
#define EXPEDITED 0x02
#define SIZE_GIVEN 0x01
#define LAST_SEGMENT 0x01

#define WRONG_TOGGLE UINT32_C(0x05030000)
#define UNKNOWN_COMMAND UINT32_C(0x05040001)
#define TOO_LONG UINT32_C(0x06070012)

// Reply to the beginning of a transfer: command, index, subindex, four bytes.
static void reply(struct can_node *node, uint8_t command, uint32_t data)
{
    const struct can_sdo *sdo = &node->sdo;
    can_send(node, SDO_REPLY,
             command | (uint64_t)sdo->index << 8 | (uint64_t)sdo->subindex << 24 |
                 (uint64_t)data << 32,
             8);
}

static void abort_transfer(struct can_node *node, uint32_t code)
{
    node->sdo.transfer = SDO_IDLE;
    reply(node, ABORT_REPLY, code);
}

static void begin_upload(struct can_node *node)
{
    struct can_sdo *sdo = &node->sdo;
    uint32_t data = 0, code = can_read_object(node, sdo);
    if (code != 0) {
        abort_transfer(node, code);
        return;
    }
    if (sdo->length >= 1 && sdo->length <= 4) {
        for (int i = sdo->length - 1; i >= 0; i--)
            data = data << 8 | sdo->bytes[i];
        sdo->transfer = SDO_IDLE;
        reply(node, (uint8_t)(UPLOAD_REPLY | EXPEDITED | SIZE_GIVEN | (4 - sdo->length) << 2), data);
        return;
    }
    sdo->transfer = SDO_UPLOAD;
    sdo->toggle = false;
    sdo->at = 0;
    reply(node, UPLOAD_REPLY | SIZE_GIVEN, sdo->length);
}

static void upload_segment(struct can_node *node, uint8_t command)
{
    struct can_sdo *sdo = &node->sdo;
    uint64_t data = 0;
    uint16_t size = (uint16_t)(sdo->length - sdo->at);
    if (sdo->transfer != SDO_UPLOAD || ((command & TOGGLE) != 0) != sdo->toggle) {
        abort_transfer(node, sdo->transfer == SDO_UPLOAD ? WRONG_TOGGLE : UNKNOWN_COMMAND);
        return;
    }
    if (size > 7)
        size = 7;
    for (int i = size - 1; i >= 0; i--)
        data = data << 8 | sdo->bytes[sdo->at + i];
    sdo->at = (uint16_t)(sdo->at + size);
    uint8_t head = (uint8_t)((sdo->toggle ? TOGGLE : 0) | (7 - size) << 1);
    if (sdo->at == sdo->length) {
        head |= LAST_SEGMENT;
        sdo->transfer = SDO_IDLE;
    }
    sdo->toggle = !sdo->toggle;
    can_send(node, SDO_REPLY, head | data << 8, 8);
}

static void begin_download(struct can_node *node, const uint8_t request[8])
{
    struct can_sdo *sdo = &node->sdo;
    sdo->transfer = SDO_IDLE;
    sdo->length = 0;
    if (!(request[0] & EXPEDITED)) {
        sdo->transfer = SDO_DOWNLOAD;
        sdo->toggle = false;
        reply(node, DOWNLOAD_REPLY, 0);
        return;
    }
    sdo->length = (request[0] & SIZE_GIVEN) ? (uint16_t)(4 - (request[0] >> 2 & 3)) : 4;
    memcpy(sdo->bytes, request + 4, sdo->length);
    uint32_t code = can_write_object(node, sdo);
    reply(node, code == 0 ? DOWNLOAD_REPLY : ABORT_REPLY, code);
}

static void download_segment(struct can_node *node, const uint8_t request[8])
{
    struct can_sdo *sdo = &node->sdo;
    uint16_t size = (uint16_t)(7 - (request[0] >> 1 & 7));
    if (sdo->transfer != SDO_DOWNLOAD || ((request[0] & TOGGLE) != 0) != sdo->toggle) {
        abort_transfer(node, sdo->transfer == SDO_DOWNLOAD ? WRONG_TOGGLE : UNKNOWN_COMMAND);
        return;
    }
    if (sdo->length + size > SDO_BUFFER) {
        abort_transfer(node, TOO_LONG);
        return;
    }
    memcpy(sdo->bytes + sdo->length, request + 1, size);
    sdo->length = (uint16_t)(sdo->length + size);
    if (request[0] & LAST_SEGMENT) {
        sdo->transfer = SDO_IDLE;
        uint32_t code = can_write_object(node, sdo);
        if (code != 0) {
            abort_transfer(node, code);
            return;
        }
    }
    can_send(node, SDO_REPLY, DOWNLOAD_SEGMENT_REPLY | (sdo->toggle ? TOGGLE : 0u), 8);
    sdo->toggle = !sdo->toggle;
}

void can_sdo_receive(struct can_node *node, const uint8_t request[8])
{
    struct can_sdo *sdo = &node->sdo;
    uint8_t command = request[0] >> 5;
    if (command != DOWNLOAD_SEGMENT && command != UPLOAD_SEGMENT && command != ABORT) {
        sdo->index = (uint16_t)(request[1] | request[2] << 8);
        sdo->subindex = request[3];
    }
    switch (command) {
    case DOWNLOAD:
        begin_download(node, request);
        break;
    case UPLOAD:
        begin_upload(node);
        break;
    case DOWNLOAD_SEGMENT:
        download_segment(node, request);
        break;
    case UPLOAD_SEGMENT:
        upload_segment(node, request[0]);
        break;
    case ABORT:
        sdo->transfer = SDO_IDLE;
        break;
    default:
        abort_transfer(node, UNKNOWN_COMMAND);
    }
}
