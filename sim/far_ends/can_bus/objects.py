"""The object dictionary of a simulated amplifier.

Indices and ranges are those of protocol.yaml; the encoding shares no code with the host's side.
"""

import struct
import zlib
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from drivers.protocol.definition import PROTOCOL, Quantity
from drivers.protocol.messages import FaultList, GetFaults, LoadEnvelope, Nak
from sim.bench.simulated_device import SimulatedDevice
from sim.far_ends.can_bus.domain_objects import ABORTS, envelope_of, faults_domain
from sim.far_ends.can_bus.sdo import (
    BAD_LENGTH,
    NO_OBJECT,
    NO_SUBINDEX,
    READ_ONLY,
    WRITE_ONLY,
    SdoAbort,
)

CANOPEN: Mapping[str, Any] = PROTOCOL.canopen
IDS: Mapping[str, int] = CANOPEN["cob_ids"]
_Q = PROTOCOL.quantities
_INDEX = {name: declared["index"] for name, declared in CANOPEN["objects"].items()}
_WIDTH = {"u8": "<B", "u16": "<H", "u32": "<L", "i16": "<h"}
_PDO_SYNCHRONOUS, _PDO_ASYNCHRONOUS = 0, 255
_RPDO, _RPDO_MAP, _TPDO, _TPDO_MAP = 0x1400, 0x1600, 0x1800, 0x1A00
_REQUEST_PDO, _SLOTS_PDO = 16, 17  # RPDO 17, 18, ..., for any number of channels

Read = Callable[[], bytes]
Write = Callable[[bytes], None]


def channel_ids(node: int, channels: int) -> dict[int, int]:
    """Channel by RPDO identifier of a node."""
    return {
        IDS["command"] + 0x100 * (channel % 4) + node + channel // 4: channel
        for channel in range(channels)
    }


def sent_ids(node: int, channels: int) -> tuple[int, ...]:
    """TPDO identifiers of a node: reply, status, then levels of four channels each."""
    levels = (IDS["levels"] + node + group for group in range(-(-channels // 4)))
    return (IDS["answer"] + node, IDS["condition"] + node, *levels)


class ObjectDictionary:
    """The objects of one amplifier; pdo_written: called when an RPDO object is written.

    host: node whose heartbeat feeds the watchdog, 0 for none; heartbeat [ms]: its own interval.
    """

    def __init__(
        self, device: SimulatedDevice, node: int, *, pdo_written: Callable[[int, bytes], None]
    ) -> None:
        self._device = device
        self._node = node
        self._pdo_written = pdo_written
        self._channels = device.capabilities.channels
        self.achieved = b""
        self.blocks: dict[int, bytes] = {}  # last data by PDO identifier
        self.reset()
        self._reads: dict[tuple[int, int], Read] = {}
        self._writes: dict[tuple[int, int], Write] = {}
        self._fill()

    def reset(self) -> None:
        """Reset the communication objects."""
        self.host = 0
        self.watchdog = 0
        self.heartbeat = int(CANOPEN["heartbeat_ms"])

    def read(self, index: int, subindex: int) -> bytes:
        """Read an object; raises SdoAbort."""
        found = self._reads.get((index, subindex))
        if found is None:
            raise SdoAbort(self._missing(index, subindex, elsewhere=self._writes, code=WRITE_ONLY))
        return found()

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Write an object; raises SdoAbort."""
        found = self._writes.get((index, subindex))
        if found is None:
            raise SdoAbort(self._missing(index, subindex, elsewhere=self._reads, code=READ_ONLY))
        found(data)

    def _missing(
        self,
        index: int,
        subindex: int,
        *,
        elsewhere: Mapping[tuple[int, int], object],
        code: int,
    ) -> int:
        if (index, subindex) in elsewhere:
            return code
        known = any(index == other for other, _ in (*self._reads, *self._writes))
        return NO_SUBINDEX if known else NO_OBJECT

    def _fill(self) -> None:
        self._communication()
        self._identity()
        self._status()
        self._pdos()
        for slot in range(1, 64):
            self._writes[_INDEX["envelope"], slot] = partial(self._load, slot)
        self._reads[_INDEX["envelope"], 0] = lambda: b"\x3f"

    def _communication(self) -> None:
        self._constant("device_type", 0, _pack("u32", CANOPEN["device_type"]))
        self._reads[_INDEX["error_register"], 0] = self._error_register
        self._constant("sync_cob_id", 0, _pack("u32", IDS["sync"]))
        self._constant("emergency_cob_id", 0, _pack("u32", IDS["emergency"] + self._node))
        consumer, producer = _INDEX["heartbeat_consumer"], _INDEX["heartbeat_producer"]
        self._count(consumer, 1)
        self._reads[consumer, 1] = lambda: _pack("u32", self.host << 16 | self.watchdog)
        self._writes[consumer, 1] = self._set_consumer
        self._reads[producer, 0] = lambda: _pack("u16", self.heartbeat)
        self._writes[producer, 0] = self._set_producer

    def _identity(self) -> None:
        numbers = [CANOPEN["vendor_id"], CANOPEN["product_code"], CANOPEN["revision"]]
        self._record("identity", [_pack("u32", value) for value in numbers])
        self._count(_INDEX["identity"], 4)
        self._reads[_INDEX["identity"], 4] = self._serial_number
        texts = ("vendor", "product", "serial_number", "firmware")
        self._count(_INDEX["texts"], len(texts))
        for subindex, text in enumerate(texts, start=1):
            self._reads[_INDEX["texts"], subindex] = partial(self._text, text)
        able = self._device.capabilities
        kinds = CANOPEN["objects"]["capabilities"]["types"]
        values = {**_fields(able), "protocol_version": self._device.identity.protocol_version}
        self._record(
            "capabilities",
            [_scaled(_quantity(kind), values[name]) for name, kind in kinds.items()],
        )

    def _status(self) -> None:
        status, index = self._device.status, _INDEX["status"]
        self._count(index, 7)
        self._reads[index, 1] = lambda: bytes([status().state])
        self._reads[index, 2] = lambda: bytes([status().fault])
        self._reads[index, 3] = lambda: _pack("u16", status().token)
        self._reads[index, 4] = lambda: bytes([status().high_voltage])
        self._reads[index, 5] = lambda: _scaled(_Q.voltage, status().voltage)
        self._reads[index, 6] = lambda: _scaled(_Q.temperature, status().temperature)
        self._reads[index, 7] = lambda: _scaled(_Q.watchdog_left, status().watchdog_left)
        levels = _INDEX["channel_levels"]
        self._count(levels, self._channels)
        for channel in range(self._channels):
            self._reads[levels, channel + 1] = partial(self._level, channel)
        self._reads[_INDEX["achieved"], 0] = lambda: self.achieved
        self._reads[_INDEX["faults"], 0] = self._faults

    def _pdos(self) -> None:
        """The fixed PDOs, and the objects that they map."""
        command, order, slots = _INDEX["command"], _INDEX["order"], _INDEX["slots"]
        groups = -(-self._channels // 4)
        self._count(command, self._channels)
        self._count(slots, groups)
        for cob_id, channel in channel_ids(self._node, self._channels).items():
            self._received_pdo(channel, cob_id, command, channel + 1)
        self._received_pdo(_REQUEST_PDO, IDS["order"] + self._node, order, 0)
        for group in range(groups):
            self._received_pdo(_SLOTS_PDO + group, IDS["slots"] + self._node, slots, group + 1)
        sent = [("answer", 0), ("condition", 0), *(("levels", 1 + n) for n in range(groups))]
        self._count(_INDEX["levels"], groups)
        sent_by = sent_ids(self._node, self._channels)
        for number, (cob_id, (name, subindex)) in enumerate(zip(sent_by, sent, strict=True)):
            self._reads[_INDEX[name], subindex] = partial(self._block, cob_id)
            self._pdo(
                _TPDO + number,
                _TPDO_MAP + number,
                cob_id,
                _PDO_ASYNCHRONOUS,
                _INDEX[name],
                subindex,
            )

    def _received_pdo(self, number: int, cob_id: int, index: int, subindex: int) -> None:
        is_command = index == _INDEX["command"]
        kind = _PDO_SYNCHRONOUS if is_command else _PDO_ASYNCHRONOUS
        self._pdo(_RPDO + number, _RPDO_MAP + number, cob_id, kind, index, subindex)
        self._writes[index, subindex] = lambda data: self._write_pdo(cob_id, data)
        self._reads[index, subindex] = partial(self._block, cob_id)

    def _pdo(
        self, parameter: int, mapping: int, cob_id: int, kind: int, index: int, subindex: int
    ) -> None:
        self._count(parameter, 2)
        self._reads[parameter, 1] = lambda: _pack("u32", cob_id)
        self._reads[parameter, 2] = lambda: bytes([kind])
        self._count(mapping, 1)
        self._reads[mapping, 1] = lambda: _pack("u32", index << 16 | subindex << 8 | 64)

    def _write_pdo(self, cob_id: int, data: bytes) -> None:
        if len(data) != 8:
            raise SdoAbort(BAD_LENGTH)
        self.blocks[cob_id] = data
        self._pdo_written(cob_id, data)

    def _serial_number(self) -> bytes:
        """The CRC-32 of its text."""
        return _pack("u32", zlib.crc32(self._device.identity.serial_number.encode()))

    def _text(self, name: str) -> bytes:
        text: str = getattr(self._device.identity, name)
        return text.encode()

    def _block(self, cob_id: int) -> bytes:
        return self.blocks.get(cob_id, bytes(8))

    def _level(self, channel: int) -> bytes:
        return _scaled(_Q.level, self._device.status().levels[channel])

    def _set_consumer(self, data: bytes) -> None:
        value = _unpack("u32", data)
        self.watchdog, self.host = value & 0xFFFF, value >> 16 & 0x7F

    def _set_producer(self, data: bytes) -> None:
        self.heartbeat = _unpack("u16", data)

    def _error_register(self) -> bytes:
        fault = self._device.status().fault
        return bytes([CANOPEN["emergencies"][fault.name]["error_register"]])

    def _faults(self) -> bytes:
        reply = self._device.exchange(GetFaults())
        return faults_domain(reply.faults if isinstance(reply, FaultList) else ())

    def _load(self, slot: int, data: bytes) -> None:
        reply = self._device.exchange(LoadEnvelope(envelope_of(slot, data)))
        if isinstance(reply, Nak):
            raise SdoAbort(ABORTS[reply.code])

    def _constant(self, name: str, subindex: int, value: bytes) -> None:
        self._reads[_INDEX[name], subindex] = lambda: value

    def _record(self, name: str, values: list[bytes]) -> None:
        self._count(_INDEX[name], len(values))
        for subindex, value in enumerate(values, start=1):
            self._constant(name, subindex, value)

    def _count(self, index: int, count: int) -> None:
        self._reads[index, 0] = lambda: bytes([count])


def _fields(values: Any) -> dict[str, float]:
    return {name: getattr(values, name) for name in values.__dataclass_fields__}


def _quantity(name: str) -> Quantity:
    found: Quantity = getattr(_Q, name)
    return found


def _scaled(quantity: Quantity, value: float) -> bytes:
    return _pack(quantity.wire, quantity.to_wire(min(max(value, quantity.low), quantity.high)))


def _pack(kind: str, value: int) -> bytes:
    return struct.pack(_WIDTH[kind], value)


def _unpack(kind: str, data: bytes) -> int:
    if len(data) != struct.calcsize(_WIDTH[kind]):
        raise SdoAbort(BAD_LENGTH)
    (value,) = struct.unpack(_WIDTH[kind], data)
    return int(value)
