"""Reads of a node's objects (SDO uploads of CiA 301), from docs/reference/wire-can.md#objects.

Decoded are identity, capabilities, limits of channels, and the list of faults. Of other objects,
and of writes, only that there was a transfer.
"""

from dataclasses import dataclass

from sim.witness.can_text import CanFrame
from sim.witness.decoded import Reply
from sim.witness.quantities import OutOfRange
from sim.witness.reports import check_text, unpack_fault_records

_IDENTITY, _FAULTS = 0x2000, 0x2008
_CONSTANT = (0x1018, _IDENTITY, 0x2001, 0x2009, 0x200A, 0x200B)
_TEXTS = range(1, 5)  # subindices of the identity
_VOICES = (0x2001, 16)
_UPLOAD, _SEGMENT = 2, 3  # commands of the host, in bits 5 to 7; 0 and 2 answer them


@dataclass
class _Upload:
    """An object that is read since a time [s], and what has come of it.

    toggle: of the next segment, None before the first answer.
    """

    item: tuple[int, int]
    begun: float
    data: bytes = b""
    toggle: int | None = None


class CanTransfers:
    """Reads of the objects of one node."""

    def __init__(self, node: int) -> None:
        self._node = node
        self._upload: _Upload | None = None

    def requested(self, time: float, frame: CanFrame) -> None:
        """Process a frame of the host at a time [s]."""
        command = frame.data[0] >> 5
        if command == _UPLOAD:
            item = int.from_bytes(frame.data[1:3], "little"), frame.data[3]
            self._upload = _Upload(item, time)
        elif command != _SEGMENT:  # a write, or an abort
            self._upload = None

    def answered(self, frame: CanFrame) -> Reply:
        """Decode a frame of the node: with its last one, what was read."""
        upload = self._upload
        if upload is None or not self._is_complete(upload, frame.data):
            # The transfer may have fed the watchdog at any time.
            return Reply(self._node, "objects")
        self._upload = None
        return _read(self._node, upload)

    def _is_complete(self, upload: _Upload, frame: bytes) -> bool:
        """Take a frame of an upload; whether it was the last."""
        command, flags = frame[0] >> 5, frame[0] & 0x1F
        if upload.toggle is None and command == 2:
            item = int.from_bytes(frame[1:3], "little"), frame[3]
            if item != upload.item:  # the answer to an earlier read
                return False
            if flags & 2:  # expedited; bit 0: bits 2 and 3 are the number of unused bytes
                upload.data = frame[4 : 8 - (flags >> 2 & 3 if flags & 1 else 0)]
                return True
            upload.toggle = 0
        elif upload.toggle is not None and command == 0 and flags >> 4 == upload.toggle:
            upload.data += frame[1 : 8 - (flags >> 1 & 7)]
            upload.toggle ^= 1
            return bool(flags & 1)
        elif command == 4:  # an abort
            self._upload = None
        return False


def _read(node: int, upload: _Upload) -> Reply:
    """Decode what was read."""
    item, data, problem = upload.item, upload.data, ""
    index, subindex = item
    if index == _FAULTS:
        try:
            faults = unpack_fault_records(data)
        except OutOfRange as found:
            return Reply(node, "objects", item=item, problem=str(found))
        return Reply(node, "objects", item=item, begun=upload.begun, faults=faults)
    if index not in _CONSTANT:
        return Reply(node, "objects")
    if index == _IDENTITY and subindex in _TEXTS:
        try:
            check_text(data)
        except OutOfRange as found:
            problem = str(found)
    voices = data[0] if item == _VOICES and data else 0
    return Reply(node, "objects", item=item, constant=data, voices=voices, problem=problem)
