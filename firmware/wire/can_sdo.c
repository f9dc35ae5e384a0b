// SPDX-License-Identifier: MIT
//
// The SDO server of CiA 301: expedited and segmented uploads, and expedited downloads, since nothing
// longer than four bytes can be written.

#include "can.h"

#include <string.h>

#define SDO_REPLY 0x580

// Command specifiers: of the client, in the highest three bits of the first byte.
enum client { DOWNLOAD = 1, UPLOAD = 2, UPLOAD_SEGMENT = 3, ABORT = 4 };

#define UPLOAD_REPLY 0x40
#define DOWNLOAD_REPLY 0x60
#define ABORT_REPLY 0x80
#define TOGGLE 0x10
#define EXPEDITED 0x02
#define SIZE_GIVEN 0x01
#define LAST_SEGMENT 0x01

#define WRONG_TOGGLE UINT32_C(0x05030000)
#define UNKNOWN_COMMAND UINT32_C(0x05040001)

// Reply to the beginning of a transfer: command, index, subindex, four bytes.
static void reply(struct can_node *node, uint8_t command, uint32_t data)
{
    const struct can_sdo *sdo = &node->sdo;
    uint8_t bytes[8] = {command, (uint8_t)sdo->index, (uint8_t)(sdo->index >> 8), sdo->subindex};
    for (int i = 0; i < 4; i++)
        bytes[4 + i] = (uint8_t)(data >> 8 * i);
    can_send(node, SDO_REPLY, bytes, 8);
}

static void abort_transfer(struct can_node *node, uint32_t code)
{
    node->sdo.is_uploading = false;
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
        sdo->is_uploading = false;
        reply(node, (uint8_t)(UPLOAD_REPLY | EXPEDITED | SIZE_GIVEN | (4 - sdo->length) << 2), data);
        return;
    }
    sdo->is_uploading = true;
    sdo->toggle = false;
    sdo->at = 0;
    reply(node, UPLOAD_REPLY | SIZE_GIVEN, sdo->length);
}

static void upload_segment(struct can_node *node, uint8_t command)
{
    struct can_sdo *sdo = &node->sdo;
    uint8_t data[8] = {0};
    uint16_t size = (uint16_t)(sdo->length - sdo->at);
    if (!sdo->is_uploading || ((command & TOGGLE) != 0) != sdo->toggle) {
        abort_transfer(node, sdo->is_uploading ? WRONG_TOGGLE : UNKNOWN_COMMAND);
        return;
    }
    if (size > 7)
        size = 7;
    memcpy(data + 1, sdo->bytes + sdo->at, size);
    sdo->at = (uint16_t)(sdo->at + size);
    data[0] = (uint8_t)((sdo->toggle ? TOGGLE : 0) | (7 - size) << 1);
    if (sdo->at == sdo->length) {
        data[0] |= LAST_SEGMENT;
        sdo->is_uploading = false;
    }
    sdo->toggle = !sdo->toggle;
    can_send(node, SDO_REPLY, data, 8);
}

static void download(struct can_node *node, const uint8_t request[8])
{
    struct can_sdo *sdo = &node->sdo;
    uint32_t code = UNKNOWN_COMMAND;
    sdo->is_uploading = false;
    if (request[0] & EXPEDITED) {
        sdo->length = (request[0] & SIZE_GIVEN) ? (uint16_t)(4 - (request[0] >> 2 & 3)) : 4;
        memcpy(sdo->bytes, request + 4, sdo->length);
        code = can_write_object(node, sdo);
    }
    reply(node, code == 0 ? DOWNLOAD_REPLY : ABORT_REPLY, code);
}

void can_sdo_receive(struct can_node *node, const uint8_t request[8])
{
    struct can_sdo *sdo = &node->sdo;
    uint8_t command = request[0] >> 5;
    if (command == DOWNLOAD || command == UPLOAD) {
        sdo->index = can_u16(request + 1);
        sdo->subindex = request[3];
    }
    switch (command) {
    case DOWNLOAD:
        download(node, request);
        break;
    case UPLOAD:
        begin_upload(node);
        break;
    case UPLOAD_SEGMENT:
        upload_segment(node, request[0]);
        break;
    case ABORT:
        sdo->is_uploading = false;
        break;
    default:
        abort_transfer(node, UNKNOWN_COMMAND);
    }
}
