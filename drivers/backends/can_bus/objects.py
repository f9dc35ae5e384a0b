"""Objects of one amplifier, read and written with `canopen`'s SDO client; everything here blocks.

One transfer at a time, by one thread. A transfer that was broken off may leave an answer on its
way, so before the next an object that is never asked for otherwise is read until it is told.
"""

import queue
import struct
from collections.abc import Callable
from typing import TypeVar

import canopen
from canopen.objectdictionary import ObjectDictionary
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from drivers.backends.hardware import Worker
from drivers.backends.waiting import SETTLE
from drivers.codec.can_bus.frame import cob_id
from drivers.codec.can_bus.objects import (
    TEXTS,
    capability_entries,
    index_of,
    nak_of_abort,
    pack_envelope,
    read_integer,
    unpack_achieved,
    unpack_capabilities,
    unpack_faults,
    unpack_identity,
)
from drivers.errors import FrameError, LinkError, LinkTimeout
from drivers.protocol.messages import (
    Achieved,
    Capabilities,
    FaultList,
    Identity,
    Loaded,
    LoadEnvelope,
    Nak,
)

_LENGTH = 8
_WAITING_MAX = 256  # answers; a bus that is flooded with them must not fill the memory
_RESYNCHRONISE = 5  # tries
_BLOCK_FROM = 15  # bytes; shorter ones are sooner sent in segments
_ABORTED_COMMAND = 0x0504_0001  # the amplifier takes no block transfers
_TIMED_OUT = 0x0504_0000  # one of the two sides has waited too long
_DISTURBED = (_TIMED_OUT, 0x0503_0000, 0x0504_0003, 0x0504_0004)  # or toggle, sequence, CRC wrong
_ABANDON = struct.pack("<BHBL", 0x80, 0, 0, _TIMED_OUT)

_T = TypeVar("_T")


class _Client(SdoClient):
    """`canopen`'s client, which waits as its worker does, and asks nothing that nobody wants."""

    def __init__(self, node: int, worker: Worker) -> None:
        self.is_given_up = False  # the transfer that is under way
        self.is_closed = False
        self._make_queue = worker.make_queue
        super().__init__(  # type: ignore[no-untyped-call]
            cob_id("sdo_request", node), cob_id("sdo_answer", node), ObjectDictionary()
        )

    @property
    def responses(self) -> "queue.Queue[bytes]":
        """What has come."""
        return self._responses

    @responses.setter
    def responses(self, empty: "queue.Queue[bytes]") -> None:
        """The client forgets what has come by taking another queue."""
        self._responses = self._make_queue()

    def send_request(self, request: bytes) -> None:
        """Send it, or end the transfer."""
        if self.is_given_up or self.is_closed:
            raise SdoAbortedError(_TIMED_OUT)
        super().send_request(request)  # type: ignore[no-untyped-call]


class ObjectClient:
    """The SDO client of one node, for jobs of a worker; `feed` takes its answers as they come."""

    def __init__(self, network: canopen.Network, node: int, worker: Worker) -> None:
        self.unexpected_frames = 0
        self._network = network
        self._node = node
        self._worker = worker
        self._client = _Client(node, worker)
        self._client.network = network
        self._busy = False
        self._broken = False
        self._takes_blocks = True

    def feed(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """An answer has come."""
        is_wanted = self._busy and self._client.responses.qsize() < _WAITING_MAX
        if is_wanted and len(data) == _LENGTH:
            self._client.on_response(can_id, data, timestamp)
        else:
            self.unexpected_frames += 1

    def abandon(self) -> None:
        """Let the transfer that is under way end now: nobody waits for it any more."""
        if self._busy:
            self._broken = True
            self._client.is_given_up = True  # before it is woken: it would try again
            self._client.responses.put(_ABANDON)

    def close(self) -> None:
        """Let no transfer be under way any more."""
        self._client.is_closed = True
        self.abandon()

    def identity(self, *, timeout: float) -> Identity:
        """Who it is; LinkError where two of this number answer."""

        def read() -> Identity:
            self._check_alone(timeout)
            texts = {
                name: self._client.upload(index_of("texts"), place)
                for place, name in enumerate(TEXTS, start=1)
            }
            version = capability_entries()[0]
            data = self._client.upload(version.index, version.subindex)
            return unpack_identity(texts, read_integer(version, data))

        return self._transfer(read, timeout)

    def set_heartbeat(self, milliseconds: int, *, timeout: float) -> None:
        """Have the amplifier say that it is there this often, if it does not already."""

        def write() -> None:
            index, value = index_of("heartbeat_producer"), struct.pack("<H", milliseconds)
            if self._client.upload(index, 0) != value:
                self._client.download(index, 0, value)

        self._transfer(write, timeout)

    def capabilities(self, *, timeout: float) -> Capabilities:
        """What it can play."""

        def read() -> Capabilities:
            values = {}
            for entry in capability_entries():
                data = self._client.upload(entry.index, entry.subindex)
                values[entry.name] = read_integer(entry, data)
            return unpack_capabilities(values)

        return self._transfer(read, timeout)

    def faults(self, *, timeout: float) -> FaultList:
        """What went wrong."""
        return self._transfer(
            lambda: unpack_faults(self._client.upload(index_of("faults"), 0)), timeout
        )

    def achieved(self, *, timeout: float) -> Achieved:
        """What the last set that was answered plays, where it is not what was asked for."""
        return self._transfer(
            lambda: unpack_achieved(self._client.upload(index_of("achieved"), 0)), timeout
        )

    def load_envelope(self, request: LoadEnvelope, *, timeout: float) -> Loaded | Nak:
        """Keep an envelope under its slot."""
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
        """Read the serial number, and see that no other comes in answer."""
        index, subindex = index_of("identity"), 4
        object_named = struct.pack("<HB", index, subindex)
        self._client.send_request(b"\x40" + object_named + bytes(4))
        answers = {bytes(self._client.read_response())}
        self._worker.sleep(SETTLE)
        while True:
            try:
                answers.add(self._client.responses.get_nowait())
            except queue.Empty:
                break
        # What an amplifier told too late of another object contradicts nothing.
        if len({answer for answer in answers if answer[1:4] == object_named}) > 1:
            raise LinkError(
                f"more than one amplifier answers as node {self._node}; give each on the bus a "
                "number of its own"
            )

    def _transfer(self, work: Callable[[], _T], timeout: float) -> _T:
        """Do one transfer; what `canopen` raises becomes an error of ours."""
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
            raise FrameError(f"node {self._node} refuses an object ({abort})") from abort
        except SdoCommunicationError as problem:
            raise LinkTimeout(
                f"no answer from node {self._node} within {timeout * 1e3:g} ms ({problem}); check "
                "that the amplifier is switched on, has this number, and that the bit rates agree"
            ) from problem
        except (RuntimeError, ValueError, struct.error) as problem:
            # `canopen` does not get over a last block of which the node has missed a part.
            raise self._missed() from problem
        finally:
            self._busy = False
        self._broken = False
        return result

    def _missed(self) -> LinkTimeout:
        return LinkTimeout(
            f"node {self._node} or this host missed a part of an object, or took too long over it; "
            "check that the bus is not overloaded and the cable sound"
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
