"""SDO transfers with one amplifier by `canopen`; everything here blocks.

One transfer at a time, in one thread. An aborted transfer may leave a late reply, so the next one
first reads an object that is not used otherwise until its reply arrives.
"""

import queue
import struct
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TypeVar

import canopen
from canopen.objectdictionary import ObjectDictionary
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from drivers.backends.waiting import DUPLICATE_WAIT
from drivers.codec.can_bus.frame import cob_id
from drivers.codec.can_bus.objects import (
    CAPABILITY_ENTRIES,
    TEXTS,
    Entry,
    index_of,
    limit_entries,
    measured_entries,
    nak_of_abort,
    pack_envelope,
    read_integer,
    unpack_achieved,
    unpack_capabilities,
    unpack_faults,
    unpack_identity,
    unpack_measured,
)
from drivers.codec.payload import Cursor
from drivers.codec.sensors import (
    pack_get_block,
    pack_measure,
    unpack_block,
    unpack_reading_head,
    unpack_sensor,
    unpack_sensor_reading,
)
from drivers.errors import FrameError, LinkError, LinkTimeout
from drivers.hardware import Worker
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Achieved,
    Capabilities,
    FaultList,
    GetBlock,
    GetReading,
    GetSensors,
    Identity,
    Loaded,
    LoadEnvelope,
    Measure,
    Measured,
    Nak,
    NakCode,
    Reading,
    ReadingState,
    SampleBlock,
    SensorList,
    SetAddress,
)
from drivers.statistics import WireCounters

_LENGTH = 8
_SENSORS_LISTED = 8  # in one exchange, for whose end a heartbeat waits
_TONES_HEAD, _TONE_SIZE = 3, 6  # bytes
_WAITING_MAX = 256  # replies; bounds the memory on a flooded bus
_RESYNCHRONISE = 5  # tries
_BLOCK_FROM = 15  # bytes; segments are faster below
_ABORTED_COMMAND = 0x0504_0001  # block transfers not supported
_NO_OBJECT = 0x0602_0000
_TIMED_OUT = 0x0504_0000  # SDO protocol timed out
_DISTURBED = (_TIMED_OUT, 0x0503_0000, 0x0504_0003, 0x0504_0004)  # or toggle, sequence, CRC wrong
_ABANDON = struct.pack("<BHBL", 0x80, 0, 0, _TIMED_OUT)

_T = TypeVar("_T")


class _Client(SdoClient):
    """`canopen`'s client with the queues of its worker; sends nothing for cancelled transfers."""

    def __init__(self, node: int, worker: Worker) -> None:
        self.is_given_up = False  # the present transfer
        self.is_closed = False
        self._make_queue = worker.make_queue
        super().__init__(  # type: ignore[no-untyped-call]
            cob_id("sdo_request", node), cob_id("sdo_answer", node), ObjectDictionary()
        )

    @property
    def responses(self) -> "queue.Queue[bytes]":
        """Received replies."""
        return self._responses

    @responses.setter
    def responses(self, empty: "queue.Queue[bytes]") -> None:
        """Take another queue, by which the client discards replies."""
        self._responses = self._make_queue()

    def send_request(self, request: bytes) -> None:
        """Send a request, or abort the transfer."""
        if self.is_given_up or self.is_closed:
            raise SdoAbortedError(_TIMED_OUT)
        super().send_request(request)  # type: ignore[no-untyped-call]


class ObjectClient:
    """SDO client of one node, for jobs of a worker; `feed` takes its replies."""

    def __init__(
        self, network: canopen.Network, node: int, worker: Worker, counters: WireCounters
    ) -> None:
        self._counters = counters
        self._node = node
        self._worker = worker
        self._client = _Client(node, worker)
        self._client.network = network
        self._busy = False
        self._broken = False
        self._takes_blocks = True

    def feed(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """Take a reply."""
        is_expected = self._busy and self._client.responses.qsize() < _WAITING_MAX
        if is_expected and len(data) == _LENGTH:
            self._client.on_response(can_id, data, timestamp)
        else:
            self._counters.unexpected_frames += 1

    def abandon(self) -> None:
        """Abort the present transfer."""
        if self._busy:
            self._broken = True
            self._client.is_given_up = True  # before it wakes up and retries
            self._client.responses.put(_ABANDON)

    def close(self) -> None:
        """Abort the present transfer and refuse others."""
        self._client.is_closed = True
        self.abandon()

    def identity(self, *, timeout: float) -> Identity:
        """Read the identity; LinkError if two nodes of this number reply."""

        def read() -> Identity:
            self._check_alone(timeout)
            texts = {
                name: self._client.upload(index_of("texts"), index)
                for index, name in enumerate(TEXTS, start=1)
            }
            versions = self._client.upload(index_of("texts"), len(TEXTS) + 1)
            return unpack_identity(texts, versions)

        return self._transfer(read, timeout)

    def set_heartbeat(self, milliseconds: int, *, timeout: float) -> None:
        """Set the interval of the amplifier's heartbeat if it differs."""

        def write() -> None:
            index, value = index_of("heartbeat_producer"), struct.pack("<H", milliseconds)
            if self._client.upload(index, 0) != value:
                self._client.download(index, 0, value)

        self._transfer(write, timeout)

    def capabilities(self, *, timeout: float) -> Capabilities:
        """Read the capabilities."""

        def read() -> Capabilities:
            values = self._integers(CAPABILITY_ENTRIES)
            limits = [
                self._integers(limit_entries(channel)) for channel in range(values["channels"])
            ]
            return unpack_capabilities(values, limits)

        return self._transfer(read, timeout)

    def _integers(self, entries: Iterable[Entry]) -> dict[str, int]:
        return {
            entry.name: read_integer(entry, self._client.upload(entry.index, entry.subindex))
            for entry in entries
        }

    def faults(self, *, timeout: float) -> FaultList:
        """Read the faults."""
        return self._transfer(
            lambda: unpack_faults(self._client.upload(index_of("faults"), 0)), timeout
        )

    def measured(self, channels: int, *, timeout: float) -> Measured | Nak:
        """Read voltage and current of so many channels; a Nak from a node that measures neither."""

        def read() -> Measured | Nak:
            try:
                each = [self._integers(measured_entries(channel)) for channel in range(channels)]
            except SdoAbortedError as abort:
                if abort.code != _NO_OBJECT:
                    raise
                return Nak(NakCode.UNKNOWN_TYPE)
            return unpack_measured(each)

        return self._transfer(read, timeout)

    def sensors(self, request: GetSensors, *, timeout: float) -> SensorList | Nak:
        """Describe the sensors from one on."""

        first = _number_of_sensor(request.first)

        def read() -> SensorList:
            count = self._sensor_count("sensors")
            found = []
            for number in range(first, min(count, first + _SENSORS_LISTED)):
                cursor = self._sensor_object("sensors", number)
                found.append(unpack_sensor(cursor))
                cursor.end()
            return SensorList(count, tuple(found))

        return self._sensor_transfer(read, timeout)

    def measure(self, request: Measure, *, timeout: float) -> Reading | Nak:
        """Begin a reading; returns it without sensors."""
        data = pack_measure(request)

        def write() -> Reading:
            self._client.download(index_of("measure"), 0, data, force_segment=True)
            return self._reading_head()

        return self._sensor_transfer(write, timeout)

    def reading(self, request: GetReading, *, timeout: float) -> Reading | Nak:
        """Read the reading, its sensors from one on; none if it was replaced meanwhile."""

        first = _number_of_sensor(request.first)

        def read() -> Reading:
            head = self._reading_head()
            if head.state not in (ReadingState.COMPLETE, ReadingState.DISTURBED):
                return head
            count = self._sensor_count("sensor_reading")
            sensors = []
            # No more bytes than over a serial line.
            fitting = PROTOCOL.serial.payload_max // (_TONES_HEAD + _TONE_SIZE * head.tone_count)
            last = min(count, first + min(fitting, _SENSORS_LISTED))
            for number in range(first, last):
                cursor = self._sensor_object("sensor_reading", number)
                if cursor.integer(PROTOCOL.quantities.held_reading) != head.number:
                    return self._reading_head()
                sensors.append(unpack_sensor_reading(cursor, head.tone_count))
                cursor.end()
            return replace(head, sensors=tuple(sensors))

        return self._sensor_transfer(read, timeout)

    def samples(self, request: GetBlock, *, timeout: float) -> SampleBlock | Nak:
        """Read raw samples of a sensor."""
        data = pack_get_block(request)

        def read() -> SampleBlock:
            self._client.download(index_of("first_sample"), 0, data, force_segment=True)
            cursor = Cursor(self._client.upload(index_of("samples"), 0))
            block = unpack_block(cursor)
            cursor.end()
            return block

        return self._sensor_transfer(read, timeout)

    def _reading_head(self) -> Reading:
        cursor = Cursor(self._client.upload(index_of("reading"), 0))
        head = unpack_reading_head(cursor)
        cursor.end()
        return head

    def _sensor_count(self, name: str) -> int:
        entry = Entry(index_of(name), 0, "sensor_count", "u8", PROTOCOL.quantities.sensor_count)
        return read_integer(entry, self._client.upload(entry.index, entry.subindex))

    def _sensor_object(self, name: str, sensor: int) -> Cursor:
        return Cursor(self._client.upload(index_of(name), sensor + 1))

    def _sensor_transfer(self, work: Callable[[], _T], timeout: float) -> _T | Nak:
        """Run one transfer; a refusal, or a node without sensors, is a Nak."""

        def run() -> _T | Nak:
            try:
                return work()
            except SdoAbortedError as abort:
                code = nak_of_abort(abort.code)
                if code is None:
                    raise
                return Nak(code)

        return self._transfer(run, timeout)

    def achieved(self, *, timeout: float) -> Achieved:
        """Read what the last set plays."""
        return self._transfer(
            lambda: unpack_achieved(self._client.upload(index_of("achieved"), 0)), timeout
        )

    def load_envelope(self, request: LoadEnvelope, *, timeout: float) -> Loaded | Nak:
        """Load an envelope into its slot."""
        data = pack_envelope(request)
        envelope = request.envelope
        index = index_of("envelope")

        def write() -> Loaded | Nak:
            try:
                self._download(index, envelope.slot, data)
            except SdoAbortedError as abort:
                code = nak_of_abort(abort.code)
                if code is None:
                    raise
                return Nak(code)
            return Loaded(slot=envelope.slot, knots=len(envelope.knots))

        return self._transfer(write, timeout)

    def set_address(self, request: SetAddress, *, timeout: float) -> None:
        """Give the node another number, which it takes at the next reset of communication."""
        data = bytes([request.address]) + request.serial_number.encode()
        self._transfer(
            lambda: self._client.download(index_of("set_address"), 0, data, force_segment=True),
            timeout,
        )

    def _download(self, index: int, subindex: int, data: bytes) -> None:
        if len(data) >= _BLOCK_FROM and self._takes_blocks:
            try:
                with self._client.open(
                    index, subindex, "wb", buffering=7, size=len(data), block_transfer=True
                ) as stream:
                    stream.write(data)
            except SdoAbortedError as abort:
                if abort.code != _ABORTED_COMMAND:
                    raise
                self._takes_blocks = False
            else:
                return
        self._client.download(index, subindex, data, force_segment=True)

    def _check_alone(self, timeout: float) -> None:
        """Read the serial number; LinkError for a second, different reply."""
        index, subindex = index_of("identity"), 4
        object_named = struct.pack("<HB", index, subindex)
        self._client.send_request(b"\x40" + object_named + bytes(4))
        replies = {bytes(self._client.read_response())}
        self._worker.sleep(DUPLICATE_WAIT)
        while True:
            try:
                replies.add(self._client.responses.get_nowait())
            except queue.Empty:
                break
        # A late reply about another object is not a second amplifier.
        if len({answer for answer in replies if answer[1:4] == object_named}) > 1:
            raise LinkError(
                f"several amplifiers reply as node {self._node}; give each its own node number"
            )

    def _transfer(self, work: Callable[[], _T], timeout: float) -> _T:
        """Run one transfer; translates exceptions of `canopen`."""
        self._client.RESPONSE_TIMEOUT = timeout
        self._client.is_given_up = False
        self._busy = True
        broken, self._broken = self._broken, True
        try:
            if broken:
                self._resynchronise()
            result = work()
        except SdoAbortedError as abort:
            if abort.code in _DISTURBED:
                raise self._missed() from abort
            self._broken = False
            raise FrameError(f"node {self._node} refuses an SDO transfer ({abort})") from abort
        except SdoCommunicationError as error:
            raise LinkTimeout(
                f"no reply from node {self._node} within {timeout * 1e3:g} ms ({error}); "
                "check that the amplifier is on, has this number, and that the bit rates agree"
            ) from error
        except (RuntimeError, ValueError, struct.error) as error:
            # `canopen` fails if the node has missed a part of the last block.
            raise self._missed() from error
        finally:
            self._busy = False
        self._broken = False
        return result

    def _missed(self) -> LinkTimeout:
        return LinkTimeout(
            f"node {self._node}: SDO transfer incomplete or timed out; check that the bus is not "
            "overloaded, and the cable"
        )

    def _resynchronise(self) -> None:
        for left in reversed(range(_RESYNCHRONISE)):
            try:
                self._client.upload(index_of("error_register"), 0)
            except (SdoAbortedError, SdoCommunicationError):
                if not left:
                    raise
            else:
                return


def _number_of_sensor(sensor: int) -> int:
    """Return the number of a sensor; CommandError for one out of range."""
    return PROTOCOL.quantities.sensor.to_wire(sensor)
