"""Raw access to a CAN bus."""

import asyncio
from collections.abc import Sequence
from dataclasses import replace

from drivers.backends.can_bus.bus import CanBus, can_bus
from drivers.codec.can_bus.frame import CANOPEN, LAYOUTS, CanFrame, cob_id
from drivers.codec.can_bus.requests import encode_broadcast, encode_request
from drivers.codec.can_bus.timing import CanTimes
from drivers.conformance.raw.line import NO_REPLY, REPLY, RawLine, RawRequest
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Apply, Broadcast, GetStatus, NakCode, Ping, Stage, Stop
from drivers.urls.can_bus import CanUrl

_TIMEOUT = 0.03  # s, beyond the time on the bus; three times the longest reaction
_SEND_TIMEOUT = 0.03  # s; for room in the transmit queue
_SETTLING = 0.002  # s
_SEQUENCE = 0xA5
_OTHER_NODE = 62
_OTHER_HOST = 3
_INCOMPLETE = 15
_COLLECTING = 1.1 * float(CANOPEN["incomplete_life"])  # s; then an incomplete set is forgotten
_Q = PROTOCOL.quantities


class CanRaw(RawLine):
    """Raw access to the bus of an open amplifier at a URL."""

    page = "wire-can.md"

    def __init__(self, url: str) -> None:
        self.url = url
        self._url = CanUrl.parse(url)

    @property
    def address(self) -> int:
        """See `RawLine`."""
        return self._url.node

    async def send(self, request: RawRequest) -> str:
        """See `RawLine`."""
        loop, bus = asyncio.get_running_loop(), self._bus
        replies: asyncio.Queue[bytes] = asyncio.Queue()

        def heard(can_id: int, data: bytearray, timestamp: float) -> None:
            loop.call_soon_threadsafe(replies.put_nowait, bytes(data))

        answers = cob_id("answer", self._url.node)
        bus.network.subscribe(answers, heard)
        try:
            # The reader's thread may still pass on the answer to an earlier order.
            await asyncio.sleep(_SETTLING)
            while not replies.empty():
                replies.get_nowait()
            await self._write(request)
            try:
                async with asyncio.timeout(self._time_of(request) + request.lasts + _TIMEOUT):
                    while True:
                        outcome = _outcome(await replies.get())
                        if outcome is not None:
                            return outcome
            except TimeoutError:
                return NO_REPLY
        finally:
            bus.network.unsubscribe(answers, heard)

    async def send_only(self, request: RawRequest) -> None:
        """See `RawLine`."""
        await self._write(request)
        await asyncio.sleep(self._time_of(request) + request.lasts + 0.002)

    def invalid(self, ping: Ping, apply: Apply) -> Sequence[RawRequest]:
        """See `RawLine`."""
        node = self._url.node
        *_, status = encode_request(GetStatus(), node=node, sequence=_SEQUENCE)
        other_host = CanFrame(cob_id("heartbeat", _OTHER_HOST), b"\x05")
        another_node = encode_request(apply, node=_OTHER_NODE, sequence=_SEQUENCE)
        arm = LAYOUTS["order"].pack(
            token=_OTHER_HOST, time=1000, action=CANOPEN["actions"]["arm"], sequence=_SEQUENCE
        )
        found = [
            _made("the heartbeat of another host", [other_host], NO_REPLY),
            _made("an order of seven bytes", [replace(status, data=status.data[:7])], NO_REPLY),
            _made(
                "an order with sequence number 0",
                [_with_fields(status, "order", {"sequence": 0})],
                NO_REPLY,
            ),
            _made("a set for another node", another_node, NO_REPLY),
            _made("an arm of another host", [replace(status, data=arm)], "WRONG_SESSION"),
            _made("a status order", [status], REPLY),
        ]
        *commands, order = encode_request(apply, node=node, sequence=_SEQUENCE)
        alone = tuple(commands)
        found += [
            _incomplete("a set without its command", (order,), "incomplete set"),
            _incomplete("a command without its order", alone, NO_REPLY),
        ]
        return [*found, *self._bad_sets(apply)]

    def _bad_sets(self, apply: Apply) -> list[RawRequest]:
        """Make sets with one field out of range."""
        in_order = [
            ("token 0", {"token": 0}, "BAD_TOKEN"),
            ("a ramp out of range", {"ramp": _Q.ramp.maximum + 1}, "BAD_VALUE"),
            ("a valid_for out of range", {"time": _Q.valid_for.maximum + 1}, "BAD_VALUE"),
        ]
        in_command = [
            ("a level out of range", {"level": _Q.level.maximum + 1}, "BAD_VALUE"),
            ("a phase out of range", {"phase": _Q.phase.maximum + 1}, "BAD_VALUE"),
            ("another channel in its command", {"channel": 1}, "BAD_CHANNEL"),
        ]
        return [
            *(
                _made(f"a set with {name}", self._with(apply, order=fields), outcome)
                for name, fields, outcome in in_order
            ),
            *(
                _made(f"a set with {name}", self._with(apply, command=fields), outcome)
                for name, fields, outcome in in_command
            ),
            _made(
                "a set with a flag that is not defined",
                self._with(apply, bits=1 << 51),
                "BAD_VALUE",
            ),
        ]

    def tolerated(self, ping: Ping) -> Sequence[RawRequest]:
        """See `RawLine`."""
        whole = encode_request(ping, node=self._url.node, sequence=_SEQUENCE)
        other_device = CanFrame(0x7A0, b"\x00" * 8)
        return [
            _made(
                "frames of another device, then a Ping", [other_device, other_device, *whole], REPLY
            ),
            _made("a command without its set, then a Ping", [self._command(), *whole], REPLY),
        ]

    def in_any_order(self, stage: Stage) -> Sequence[RawRequest]:
        """See `RawLine`."""
        frames = encode_request(stage, node=self._url.node, sequence=_SEQUENCE)
        return [
            _made("a set whose order comes first", [frames[-1], *frames[:-1]], REPLY),
            _made("a set in the opposite order", frames[::-1], REPLY),
            _made("a set of which a command comes twice", [frames[0], *frames], REPLY),
        ]

    def broadcasts(self, ping: Ping, apply: Apply) -> Sequence[RawRequest]:
        """See `RawLine`."""
        own, to_all = cob_id("order", self._url.node), cob_id("order")
        requests = {
            "a broadcast set without channels": [
                frame
                for frame in self._with(apply, order={"sequence": 0, "count": 0})
                if frame.id == own
            ],
            "a broadcast status": encode_request(
                GetStatus(), node=self._url.node, sequence=_SEQUENCE
            ),
        }
        return [
            _made(
                name,
                [replace(one, id=to_all) if one.id == own else one for one in frames],
                NO_REPLY,
            )
            for name, frames in requests.items()
        ]

    def stop_out_of_range(self) -> RawRequest:
        """See `RawLine`."""
        (stop,) = encode_request(Stop(0.0), node=self._url.node, sequence=_SEQUENCE)
        changed = _with_fields(stop, "order", {"ramp": 0xFFFF})
        return _made("a Stop with a ramp out of range", [changed], REPLY)

    def carried_out(self, request: Broadcast) -> RawRequest:
        """See `RawLine`."""
        return _made(f"a broadcast {type(request).__name__}", encode_broadcast(request), NO_REPLY)

    @property
    def _bus(self) -> CanBus:
        return can_bus(self._url.bus)

    async def _write(self, request: RawRequest) -> None:
        for number, piece in enumerate(request.pieces):
            if number:
                await asyncio.sleep(request.pause)
            assert isinstance(piece, tuple)  # noqa: S101  made here
            await self._bus.send(piece, timeout=_SEND_TIMEOUT)

    def _time_of(self, request: RawRequest) -> float:
        times = CanTimes(self._url.bus.bitrate, self._url.bus.fd)
        return sum(2 * times.frames(piece) for piece in request.pieces if isinstance(piece, tuple))

    def _command(self) -> CanFrame:
        data = LAYOUTS["command"].pack(frequency=2000, level=1, sequence=_SEQUENCE - 1)
        return CanFrame(cob_id("command", self._url.node), data)

    def _with(
        self,
        request: Apply | Stage,
        *,
        order: dict[str, int] | None = None,
        command: dict[str, int] | None = None,
        bits: int = 0,
    ) -> list[CanFrame]:
        """Encode a set in classic frames with changed fields, or bits, of its order or commands."""
        node = self._url.node
        changed = []
        for frame in encode_request(request, node=node, sequence=_SEQUENCE):
            if frame.id == cob_id("order", node) and order:
                frame = _with_fields(frame, "order", order)
            elif frame.id == cob_id("command", node):
                frame = _with_fields(frame, "command", command or {})
                whole = int.from_bytes(frame.data, "little") | bits
                frame = replace(frame, data=whole.to_bytes(8, "little"))
            changed.append(frame)
        return changed


def _with_fields(frame: CanFrame, layout: str, changed: dict[str, int]) -> CanFrame:
    fields = LAYOUTS[layout].unpack(frame.data)
    assert fields is not None  # noqa: S101  made here
    return replace(frame, data=LAYOUTS[layout].pack(**{**fields, **changed}))


def _outcome(data: bytes) -> str | None:
    """Describe an answer; None for an event."""
    fields = LAYOUTS["answer"].unpack(data[:8], is_reply=True)
    if fields is None:
        return f"an answer of {len(data)} bytes"
    if fields["sequence"] == 0:
        return None
    if fields["sequence"] != _SEQUENCE:
        return f"an answer with sequence number {fields['sequence']}"
    result = fields["result"]
    if result == _INCOMPLETE:
        return "incomplete set"
    return NakCode(result).name if result else REPLY


def _incomplete(name: str, frames: tuple[CanFrame, ...], outcome: str) -> RawRequest:
    return RawRequest(name, (frames,), frozenset({outcome}), lasts=_COLLECTING)


def _made(name: str, frames: Sequence[CanFrame], outcome: str) -> RawRequest:
    return RawRequest(name, (tuple(frames),), frozenset({outcome}))
