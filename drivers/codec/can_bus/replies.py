"""Replies and events from CAN frames; no I/O."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from drivers.codec.can_bus.frame import BLOCK, CANOPEN, LAYOUTS, CanFrame, cob_id
from drivers.errors import FrameError
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    AmplifierEvent,
    AmplifierState,
    Fault,
    Nak,
    NakCode,
    Reply,
    Status,
)

UNSOLICITED = 0  # sequence number of events
_Q = PROTOCOL.quantities
_ACTIONS: Mapping[str, int] = CANOPEN["actions"]
_INCOMPLETE_SET: int = CANOPEN["incomplete_set"]
_NO_CHANNEL: int = CANOPEN["no_channel"]
_STATES = {state.value: state for state in AmplifierState}


@dataclass(frozen=True, slots=True)
class CanReply:
    """Reply to a request, or with sequence 0 an event.

    event: state, fault and channel at fault; refusal: None if carried out; exact: the set plays
    exactly as requested. status: in replies to requests not about sets, unless refused.
    """

    sequence: int
    action: int
    event: AmplifierEvent
    token: int
    exact: bool
    refusal: Nak | None
    status: Status | None


@dataclass
class CanReplyReader:
    """Assembles the replies of one amplifier from frames.

    A reply is complete with its last frame, the answer, if all its frames have the same sequence
    number; incomplete ones are discarded.
    """

    node: int
    _condition: dict[str, int] = field(default_factory=dict)
    _levels: dict[int, dict[str, int]] = field(default_factory=dict)

    @property
    def ids(self) -> tuple[int, ...]:
        """COB-IDs of the frames of replies."""
        each = CANOPEN["channels_per_node"]
        groups = range(_Q.channel_count.maximum // each)
        return (
            cob_id("answer", self.node),
            cob_id("condition", self.node),
            *(cob_id("levels", self.node + group) for group in groups),
        )

    def feed(self, frame: CanFrame) -> CanReply | None:
        """Take a frame with one of `ids`; returns a reply once it is complete.

        Raises FrameError for an invalid frame.
        """
        if frame.id == cob_id("answer", self.node):
            return self._answer(frame.data)
        if frame.id == cob_id("condition", self.node):
            self._condition = _unpack("condition", frame.data)
        else:
            group = frame.id - cob_id("levels", self.node)
            self._levels[group] = _unpack("levels", frame.data)
        return None

    def _answer(self, data: bytes) -> CanReply | None:
        if len(data) > BLOCK:  # CAN FD: condition and levels follow in the same frame
            self._condition = _unpack("condition", data[BLOCK : 2 * BLOCK])
            count = min(self._condition["channel_count"], _Q.channel_count.maximum)
            for group in range(-(-count // CANOPEN["channels_per_node"])):
                start = (2 + group) * BLOCK
                self._levels[group] = _unpack("levels", data[start : start + BLOCK])
        values = _unpack("answer", data[:BLOCK])
        sequence, action, result = values["sequence"], values["action"], values["result"]
        event = _event(values)
        about_set = action in (_ACTIONS["apply"], _ACTIONS["stage"], _ACTIONS["commit"])
        status = None
        if sequence != UNSOLICITED and not result and not about_set:
            status = self._status(values, event)
            if status is None:
                return None
        return CanReply(
            sequence=sequence,
            action=action,
            event=event,
            token=values["active_token"],
            exact=bool(values["exact"]),
            refusal=_refusal(result, event),
            status=status,
        )

    def _status(self, reply: dict[str, int], event: AmplifierEvent) -> Status | None:
        """Return the status of a reply; None if a frame of it is missing."""
        condition = self._condition
        each = CANOPEN["channels_per_node"]
        if condition.get("sequence") != reply["sequence"]:
            return None
        count = condition["channel_count"]
        groups = [self._levels.get(group, {}) for group in range(-(-count // each))]
        if any(group.get("sequence") != reply["sequence"] for group in groups):
            return None
        levels = [group[f"level_{index}"] for group in groups for index in range(each)][:count]
        if not (
            _Q.channel_count.holds(count)
            and all(_Q.level.holds(level) for level in levels)
            and _Q.temperature.holds(condition["temperature"])
            and _Q.watchdog_left.holds(reply["watchdog_left"])
        ):
            raise FrameError("values of a status are out of range")
        return Status(
            state=event.state,
            fault=event.fault,
            token=reply["active_token"],
            high_voltage=bool(condition["high_voltage"]),
            interlock_open=bool(condition["interlock_open"]),
            temperature=_Q.temperature.from_wire(condition["temperature"]),
            watchdog_left=_Q.watchdog_left.from_wire(reply["watchdog_left"]),
            levels=tuple(_Q.level.from_wire(level) for level in levels),
            voltage=_Q.voltage.from_wire(condition["voltage"]),
            latch=condition["latch"],
        )


def decode_emergency(data: bytes) -> AmplifierEvent:
    """Decode an EMCY message; raises FrameError."""
    return _event(_unpack("emergency", data))


def _event(values: dict[str, int]) -> AmplifierEvent:
    state, fault, channel = values["state"], values["fault"], values["channel"]
    if state not in _STATES:
        raise FrameError(f"unknown state {state}")
    if channel != _NO_CHANNEL and not _Q.channel.holds(channel):
        raise FrameError(f"invalid channel {channel}")
    return AmplifierEvent(_STATES[state], Fault(fault), None if channel == _NO_CHANNEL else channel)


def plain_reply(reply: CanReply) -> Reply | None:
    """Return refusal or status; None for an accepted set."""
    return reply.refusal or reply.status


def _refusal(result: int, event: AmplifierEvent) -> Nak | None:
    if result == 0:
        return None
    if result != _INCOMPLETE_SET:
        return Nak(NakCode(result), event.channel)
    # A frame of the set was lost and nothing applied: it can be repeated, unless the state shows
    # that the complete set would be refused too.
    is_armed = event.state is AmplifierState.OPERATION_ENABLED
    return Nak(NakCode.BUSY if is_armed else NakCode.WRONG_STATE, event.channel)


def _unpack(layout: str, data: bytes) -> dict[str, int]:
    values = LAYOUTS[layout].unpack(data, is_reply=True)
    if values is None:
        raise FrameError(f"invalid {layout} frame: {data.hex(' ')}")
    return values
