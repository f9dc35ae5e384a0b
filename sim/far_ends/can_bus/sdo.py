"""SDO server (CiA 301): expedited and segmented uploads, and expedited downloads.

Others are refused, since nothing longer than four bytes can be written.
"""

import struct
from collections.abc import Callable

LENGTH = 8

TOGGLE = 0x0503_0000
UNKNOWN_COMMAND = 0x0504_0001
READ_ONLY = 0x0601_0002
NO_OBJECT = 0x0602_0000
BAD_LENGTH = 0x0607_0010
NO_SUBINDEX = 0x0609_0011
_DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = 1, 2, 3, 4  # in the highest three bits
_EXPEDITED = 2


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
        self._toggle = 0

    def receive(self, data: bytes) -> None:
        """Process a request; frames of other than eight bytes are ignored."""
        if len(data) != LENGTH:
            return
        command = data[0] >> 5
        try:
            if command in (_DOWNLOAD, _UPLOAD):
                self._rest = None
                self._object = struct.unpack_from("<HB", data, 1)
            if command == _DOWNLOAD and data[0] & _EXPEDITED:
                self._download(data)
            elif command == _UPLOAD:
                self._begin_upload()
            elif command == _UPLOAD_SEGMENT and self._rest is not None:
                self._upload_segment(self._rest, data[0] >> 4 & 1)
            elif command == _ABORT:
                self._rest = None
            else:
                raise SdoAbort(UNKNOWN_COMMAND)
        except SdoAbort as abort:
            self._rest = None
            self._send(struct.pack("<BHBL", 0x80, *self._object, abort.code))

    def _download(self, data: bytes) -> None:
        length = 4 - (data[0] >> 2 & 3) if data[0] & 1 else 4
        self._write(*self._object, data[4 : 4 + length])
        self._send(struct.pack("<BHB4x", 0x60, *self._object))

    def _begin_upload(self) -> None:
        value = self._read(*self._object)
        if 1 <= len(value) <= 4:
            command = 0x43 | (4 - len(value)) << 2
            self._send(struct.pack("<BHB4s", command, *self._object, value))
        else:
            self._rest, self._toggle = value, 0
            self._send(struct.pack("<BHBL", 0x41, *self._object, len(value)))

    def _upload_segment(self, rest: bytes, toggle: int) -> None:
        if toggle != self._toggle:
            raise SdoAbort(TOGGLE)
        piece, is_last = rest[:7], len(rest) <= 7
        command = toggle << 4 | (7 - len(piece)) << 1 | is_last
        self._toggle ^= 1
        self._rest = None if is_last else rest[7:]
        self._send(struct.pack("<B7s", command, piece))
