"""CANopen objects of a simulated amplifier, served by SDO (CiA 301), without I/O.

Object 2000 has the identity: four texts, then the versions. Objects 2001 and 2002 have the words of
the replies to GetCaps and GetStatus, one per subindex. Uploads are expedited or segmented,
downloads expedited; no object that can be written is longer than four bytes.

This is code of our own because the tests judge it with the library `canopen`, as an independent
master; with the same library on both sides it would judge itself.
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
"""Object by index."""


class ObjectServer:
    """The objects of an amplifier at a node, served to one client.

    heartbeat: its interval [ms], 0 for none; the one object that can be written.
    """

    def __init__(self, amplifier: AmplifierPort, node: int) -> None:
        self._amplifier = amplifier
        self._node = node
        self.heartbeat: int = CANOPEN["heartbeat_ms"]
        self._object = (0, 0)  # index and subindex of the transfer
        self._unsent: bytes | None = None  # end of a segmented upload
        self._toggle = 0

    def reply(self, data: bytes, now: float) -> bytes:
        """Return the reply to a request at a time [s]; empty if the frame has not eight bytes."""
        if len(data) != BLOCK:
            return b""
        try:
            return self._carry_out(data, now)
        except SdoAbort as abort:
            self._unsent = None
            return struct.pack("<BHBL", 0x80, *self._object, *abort.args)

    def _carry_out(self, data: bytes, now: float) -> bytes:
        """Return the reply to a request of eight bytes, empty to an abort; raises SdoAbort."""
        command = data[0] >> 5
        if command in (_DOWNLOAD, _UPLOAD):
            self._unsent = None
            self._object = struct.unpack_from("<HB", data, 1)
        if command == _DOWNLOAD and data[0] & _EXPEDITED:
            return self._download(data, now)
        if command == _UPLOAD:
            return self._begin_upload(now)
        if command == _UPLOAD_SEGMENT and self._unsent is not None:
            return self._upload_segment(self._unsent, data[0] >> 4 & 1)
        if command != _ABORT:
            raise SdoAbort(UNKNOWN_COMMAND)
        self._unsent = None
        return b""

    def _download(self, data: bytes, now: float) -> bytes:
        length = 4
        if data[0] & 1:  # the length is given
            length -= data[0] >> 2 & 3
        self._write(*self._object, data[4 : 4 + length], now)
        return struct.pack("<BHB4x", 0x60, *self._object)

    def _begin_upload(self, now: float) -> bytes:
        value = self.read(*self._object, now)
        if 1 <= len(value) <= 4:
            command = 0x43 | (4 - len(value)) << 2
            return struct.pack("<BHB4s", command, *self._object, value)
        self._unsent = value
        self._toggle = 0
        return struct.pack("<BHBL", 0x41, *self._object, len(value))

    def _upload_segment(self, unsent: bytes, toggle: int) -> bytes:
        if toggle != self._toggle:
            raise SdoAbort(TOGGLE)
        segment = unsent[:7]
        is_last = len(unsent) <= 7
        self._toggle ^= 1
        self._unsent = None if is_last else unsent[7:]
        command = toggle << 4 | (7 - len(segment)) << 1 | is_last
        return struct.pack("<B7s", command, segment)

    def read(self, index: int, subindex: int, now: float) -> bytes:
        """Read an object at a time [s]; raises SdoAbort."""
        entries = self._entries(index, now)
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

    def _entries(self, index: int, now: float) -> list[bytes]:
        """Return the subindices of an object: its value, or their number and then the values."""
        value = self._value(index, now)
        if isinstance(value, list):
            return [bytes([len(value)]), *value]
        return [value]

    def _value(self, index: int, now: float) -> bytes | list[bytes]:
        """Return an object without subindices, or a list of its subindices from 1 on."""
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
                serial_number = zlib.crc32(identity["serial_number"].encode())
                return [
                    _u32(CANOPEN["vendor_id"]),
                    _u32(CANOPEN["product_code"]),
                    _u32(CANOPEN["revision"]),
                    _u32(serial_number),
                ]
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
