"""Objects of an amplifier that are read by SDO.

2000 has the identity: four texts, then the versions. 2001 and 2002 have the words of the replies to
GetCaps and GetStatus, a subindex each.
"""

import struct
import zlib
from collections.abc import Callable

from drivers.codec.can_bus.canopen import CANOPEN, cob_id
from drivers.protocol.table import FAULTS, MESSAGES
from sim.far_ends.can_bus.sdo import BAD_LENGTH, NO_OBJECT, NO_SUBINDEX, READ_ONLY, SdoAbort
from sim.transport.far_end import AmplifierPort

FAULT_NAMES = {number: name for name, number in FAULTS.items()}
_INDEX = CANOPEN["objects"]
_TEXTS = ("vendor", "product", "serial_number", "firmware")


class WordObjects:
    """Objects of an amplifier at a node; now: the time [s].

    heartbeat: its interval [ms], 0 for none; the one object that can be written.
    """

    def __init__(self, amplifier: AmplifierPort, node: int, now: Callable[[], float]) -> None:
        self._amplifier = amplifier
        self._node = node
        self._now = now
        self.heartbeat: int = CANOPEN["heartbeat_ms"]

    def read(self, index: int, subindex: int) -> bytes:
        """Read an object; raises SdoAbort."""
        entries = self._entries(index)
        if not isinstance(entries, list):
            entries = [entries]
        else:
            entries.insert(0, bytes([len(entries)]))
        if subindex >= len(entries):
            raise SdoAbort(NO_SUBINDEX)
        return entries[subindex]

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Write an object; raises SdoAbort."""
        self.read(index, subindex)
        if index != _INDEX["heartbeat_producer"]:
            raise SdoAbort(READ_ONLY)
        if len(data) != 2:
            raise SdoAbort(BAD_LENGTH)
        self.heartbeat = int.from_bytes(data, "little")

    def _entries(self, index: int) -> bytes | list[bytes]:
        """Return an object, or its subindices from 1 on."""
        if index == _INDEX["device_type"]:
            return _u32(CANOPEN["device_type"])
        if index == _INDEX["error_register"]:
            return bytes([CANOPEN["emergencies"][self._amplifier.fault]["error_register"]])
        if index == _INDEX["emergency_cob_id"]:
            return _u32(cob_id("emergency", self._node))
        if index == _INDEX["heartbeat_producer"]:
            return self.heartbeat.to_bytes(2, "little")
        identity = self._amplifier.identity
        if index == _INDEX["identity"]:
            numbers = [CANOPEN[name] for name in ("vendor_id", "product_code", "revision")]
            return [*map(_u32, numbers), _u32(zlib.crc32(identity["serial_number"].encode()))]
        if index == _INDEX["texts"]:
            texts = [identity[name].encode() for name in _TEXTS]
            return [*texts, identity["versions"].to_bytes(2, "little")]
        if index == _INDEX["capabilities"]:
            return self._words("GetCaps")
        if index == _INDEX["status"]:
            return self._words("GetStatus")
        raise SdoAbort(NO_OBJECT)

    def _words(self, name: str) -> list[bytes]:
        reply = self._amplifier.handle(name, {}, self._now())
        return [word.to_bytes(2, "little") for word in MESSAGES[name].reply.pack(reply)]


def _u32(value: int) -> bytes:
    return struct.pack("<L", value)
