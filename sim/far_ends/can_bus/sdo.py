"""SDO server (CiA 301).

Expedited, segmented and block downloads, expedited and segmented uploads. Not modelled: block
uploads, which are refused.
"""

import binascii
import struct
from collections.abc import Callable

from drivers import clock

LENGTH = 8
BLOCK_SIZE = 127  # segments before an acknowledgement
_MAX_LENGTH = 1024  # bytes
_TIMEOUT = 1.0  # s; then a transfer is abandoned

TOGGLE = 0x0503_0000
UNKNOWN_COMMAND = 0x0504_0001
BAD_CRC = 0x0504_0004
NO_MEMORY = 0x0504_0005
WRITE_ONLY = 0x0601_0001
READ_ONLY = 0x0601_0002
NO_OBJECT = 0x0602_0000
BAD_LENGTH = 0x0607_0010
NO_SUBINDEX = 0x0609_0011


class SdoAbort(Exception):
    """Aborts a transfer with a code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"{code:#010x}")
        self.code = code


class SdoServer:
    """Serves one client; read and write raise SdoAbort."""

    def __init__(
        self,
        *,
        read: Callable[[int, int], bytes],
        write: Callable[[int, int, bytes], None],
        send: Callable[[bytes], None],
    ) -> None:
        self._read = read
        self._write = write
        self._send = send
        self._object = (0, 0)
        self._rest: bytes | None = None  # of an upload
        self._taken: bytearray | None = None  # of a download
        self._toggle = 0
        self._block = 0  # last segment in order of a block download; -1 at its end
        self._in_block = False
        self._check_crc = False
        self._heard = 0.0

    def reset(self) -> None:
        """Abandon the present transfer."""
        self._rest = self._taken = None
        self._in_block = False

    def receive(self, data: bytes) -> None:
        """Process a request; frames of other than eight bytes are ignored."""
        if len(data) != LENGTH:
            return
        now = clock.now()
        if now - self._heard > _TIMEOUT:
            self.reset()
        self._heard = now
        try:
            if data[0] == 0x80:
                self.reset()
            elif self._in_block and self._block >= 0:
                self._block_segment(data)
            else:
                self._command(data)
        except SdoAbort as abort:
            self.reset()
            self._send(struct.pack("<BHBL", 0x80, *self._object, abort.code))

    def _command(self, data: bytes) -> None:
        match data[0] >> 5:
            case 0:
                self._download_segment(data)
            case 1:
                self._begin_download(data)
            case 2:
                self._begin_upload(data)
            case 3:
                self._upload_segment(data)
            case 6:
                self._block_command(data)
            case _:
                raise SdoAbort(UNKNOWN_COMMAND)

    def _begin(self, data: bytes) -> None:
        self.reset()
        index, subindex = struct.unpack_from("<HB", data, 1)
        self._object = (index, subindex)
        self._toggle = 0

    def _begin_upload(self, data: bytes) -> None:
        self._begin(data)
        value = self._read(*self._object)
        if 1 <= len(value) <= 4:
            command = 0x43 | (4 - len(value)) << 2
            self._send(struct.pack("<BHB4s", command, *self._object, value))
        else:
            self._rest = value
            self._send(struct.pack("<BHBL", 0x41, *self._object, len(value)))

    def _upload_segment(self, data: bytes) -> None:
        if self._rest is None:
            raise SdoAbort(UNKNOWN_COMMAND)
        self._check_toggle(data)
        piece, self._rest = self._rest[:7], self._rest[7:]
        is_last = not self._rest
        command = self._toggle << 4 | (7 - len(piece)) << 1 | is_last
        self._toggle ^= 1
        if is_last:
            self._rest = None
        self._send(struct.pack("<B7s", command, piece))

    def _begin_download(self, data: bytes) -> None:
        self._begin(data)
        command = data[0]
        if command & 2:
            length = 4 - (command >> 2 & 3) if command & 1 else 4
            self._write(*self._object, data[4 : 4 + length])
        else:
            if command & 1 and int.from_bytes(data[4:8], "little") > _MAX_LENGTH:
                raise SdoAbort(NO_MEMORY)
            self._taken = bytearray()
        self._send(struct.pack("<BHB4x", 0x60, *self._object))

    def _download_segment(self, data: bytes) -> None:
        if self._taken is None or self._in_block:
            raise SdoAbort(UNKNOWN_COMMAND)
        self._check_toggle(data)
        self._take(data[1 : 8 - (data[0] >> 1 & 7)])
        if data[0] & 1:
            value, self._taken = bytes(self._taken), None
            self._write(*self._object, value)
        self._send(struct.pack("<B7x", 0x20 | self._toggle << 4))
        self._toggle ^= 1

    def _block_command(self, data: bytes) -> None:
        if data[0] & 1:
            self._end_block(data)
            return
        self._begin(data)
        self._check_crc = bool(data[0] & 4)
        if data[0] & 2 and int.from_bytes(data[4:8], "little") > _MAX_LENGTH:
            raise SdoAbort(NO_MEMORY)
        self._taken = bytearray()
        self._in_block, self._block = True, 0
        self._send(struct.pack("<BHBB3x", 0xA4, *self._object, BLOCK_SIZE))

    def _block_segment(self, data: bytes) -> None:
        number, is_last = data[0] & 0x7F, bool(data[0] & 0x80)
        in_order = number == self._block + 1
        if in_order:
            self._block = number
            self._take(data[1:])
        if is_last or number == BLOCK_SIZE:
            self._send(struct.pack("<BBB5x", 0xA2, self._block, BLOCK_SIZE))
            self._block = -1 if is_last and in_order else 0

    def _end_block(self, data: bytes) -> None:
        if self._taken is None or not self._in_block:
            raise SdoAbort(UNKNOWN_COMMAND)
        unused = data[0] >> 2 & 7
        value = bytes(self._taken[: len(self._taken) - unused])
        (crc,) = struct.unpack_from("<H", data, 1)
        if self._check_crc and binascii.crc_hqx(value, 0) != crc:
            raise SdoAbort(BAD_CRC)
        self.reset()
        self._write(*self._object, value)
        self._send(struct.pack("<B7x", 0xA1))

    def _take(self, piece: bytes) -> None:
        taken = self._taken if self._taken is not None else bytearray()
        if len(taken) + len(piece) > _MAX_LENGTH:
            raise SdoAbort(NO_MEMORY)
        taken += piece

    def _check_toggle(self, data: bytes) -> None:
        if data[0] >> 4 & 1 != self._toggle:
            raise SdoAbort(TOGGLE)
