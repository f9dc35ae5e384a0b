"""Objects of an amplifier, read and written by SDO (CiA 301).

2000 has the identity: four texts, then the versions. 2001 and 2002 have the words of the replies to
GetCaps and GetStatus, a subindex each. Uploads are expedited and segmented, downloads expedited;
others are refused, since nothing longer than four bytes can be written.
"""

import struct
import zlib

from drivers.protocol.definition import MESSAGES, TEXTS
from drivers.wires.can_frames import BLOCK, CANOPEN, cob_id
from sim.transport.far_end import AmplifierPort

TOGGLE = 0x0503_0000
UNKNOWN_COMMAND = 0x0504_0001
READ_ONLY = 0x0601_0002
NO_OBJECT = 0x0602_0000
BAD_LENGTH = 0x0607_0010
NO_SUBINDEX = 0x0609_0011
_DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = 1, 2, 3, 4  # in the highest three bits
_EXPEDITED = 2


class SdoAbort(Exception):
    """Aborts a transfer with a code, its only argument."""


_NAMES = {index: name for name, index in CANOPEN["objects"].items()}
"""Of objects by their index."""


class ObjectServer:
    """The objects of an amplifier at a node, served to one client.

    heartbeat: its interval [ms], 0 for none; the one object that can be written.
    """

    def __init__(self, amplifier: AmplifierPort, node: int) -> None:
        self._amplifier = amplifier
        self._node = node
        self.heartbeat: int = CANOPEN["heartbeat_ms"]
        self._object = (0, 0)
        self._rest: bytes | None = None  # of an upload
        self._toggle = 0

    def reply(self, data: bytes, now: float) -> bytes:
        """Return the reply to a request at a time [s]; none to frames of other than eight bytes."""
        if len(data) != BLOCK:
            return b""
        command = data[0] >> 5
        try:
            if command in (_DOWNLOAD, _UPLOAD):
                self._rest = None
                self._object = struct.unpack_from("<HB", data, 1)
            if command == _DOWNLOAD and data[0] & _EXPEDITED:
                length = 4 - (data[0] >> 2 & 3) if data[0] & 1 else 4
                self._write(*self._object, data[4 : 4 + length], now)
                return struct.pack("<BHB4x", 0x60, *self._object)
            if command == _UPLOAD:
                return self._begin_upload(now)
            if command == _UPLOAD_SEGMENT and self._rest is not None:
                return self._upload_segment(self._rest, data[0] >> 4 & 1)
            if command != _ABORT:
                raise SdoAbort(UNKNOWN_COMMAND)
        except SdoAbort as abort:
            self._rest = None
            return struct.pack("<BHBL", 0x80, *self._object, *abort.args)
        self._rest = None
        return b""

    def _begin_upload(self, now: float) -> bytes:
        value = self.read(*self._object, now)
        if 1 <= len(value) <= 4:
            command = 0x43 | (4 - len(value)) << 2
            return struct.pack("<BHB4s", command, *self._object, value)
        self._rest, self._toggle = value, 0
        return struct.pack("<BHBL", 0x41, *self._object, len(value))

    def _upload_segment(self, rest: bytes, toggle: int) -> bytes:
        if toggle != self._toggle:
            raise SdoAbort(TOGGLE)
        piece, is_last = rest[:7], len(rest) <= 7
        self._toggle ^= 1
        self._rest = None if is_last else rest[7:]
        return struct.pack("<B7s", toggle << 4 | (7 - len(piece)) << 1 | is_last, piece)

    def read(self, index: int, subindex: int, now: float) -> bytes:
        """Read an object at a time [s]; raises SdoAbort."""
        entries = self._entries(index, now)
        if not isinstance(entries, list):
            entries = [entries]
        else:
            entries.insert(0, bytes([len(entries)]))
        if subindex >= len(entries):
            raise SdoAbort(NO_SUBINDEX)
        return entries[subindex]

    def _write(self, index: int, subindex: int, data: bytes, now: float) -> None:
        self.read(index, subindex, now)
        if _NAMES[index] != "heartbeat_producer":
            raise SdoAbort(READ_ONLY)
        if len(data) != 2:
            raise SdoAbort(BAD_LENGTH)
        self.heartbeat = int.from_bytes(data, "little")

    def _entries(self, index: int, now: float) -> bytes | list[bytes]:
        """Return an object, or its subindices from 1 on."""
        identity = self._amplifier.identity
        match _NAMES.get(index):
            case "device_type":
                return _u32(CANOPEN["device_type"])
            case "error_register":
                return bytes([CANOPEN["emergencies"][self._amplifier.fault]["error_register"]])
            case "emergency_cob_id":
                return _u32(cob_id("emergency", self._node))
            case "heartbeat_producer":
                return self.heartbeat.to_bytes(2, "little")
            case "identity":
                numbers = [CANOPEN[name] for name in ("vendor_id", "product_code", "revision")]
                return [*map(_u32, numbers), _u32(zlib.crc32(identity["serial_number"].encode()))]
            case "texts":
                texts = [identity[field.name].encode() for field in TEXTS]
                return [*texts, identity["versions"].to_bytes(2, "little")]
            case "capabilities":
                return self._words("GetCaps", now)
            case "status":
                return self._words("GetStatus", now)
        raise SdoAbort(NO_OBJECT)

    def _words(self, name: str, now: float) -> list[bytes]:
        reply = self._amplifier.handle(name, {}, now)
        return [word.to_bytes(2, "little") for word in MESSAGES[name].reply.pack(reply)]


def _u32(value: int) -> bytes:
    return struct.pack("<L", value)
