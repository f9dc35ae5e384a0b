"""The witness: bytes of every wire in, broken rules out; it reads no clock, waits for nothing."""

import math
from collections import deque
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from typing import Any, Literal, Protocol

from sim.witness.can_decoder import CanDecoder
from sim.witness.follower import Follower
from sim.witness.host import Host
from sim.witness.modbus_decoder import ModbusDecoder
from sim.witness.plan import Plan, plan_of
from sim.witness.seen import (
    ANSWERS_DAMAGE,
    MOVING,
    Answered,
    Asked,
    Damaged,
    Data,
    Decoded,
    Kind,
    Meaning,
    Restarted,
    Told,
    Toward,
)
from sim.witness.serial_decoder import SerialDecoder
from sim.witness.set_rules import Expected
from sim.witness.side import Side
from sim.witness.violation import Report, Violation

_RECOVERY = 0.5  # s; after a fault of a wire nobody can say at once what is owed
_COPIES = 64  # frames among which one that comes again during a fault is looked for
_FORGOTTEN = 1.0  # s; an answer that comes later was meant for nobody

Wish = Literal["arm", "disarm", "stop", "clear"]


class Decoder(Protocol):
    """What takes the bytes of a kind of wire apart."""

    def feed(self, toward: Toward, time: float, data: Data) -> list[Decoded]:
        """What these bytes complete."""


class _Wire:
    """One wire: its decoder, the amplifiers on it, and whether it is in trouble."""

    def __init__(self, kind: str, sides: Mapping[int, Side]) -> None:
        self.kind = kind
        self.sides = sides
        self.troubled_until = -math.inf
        self.recent: deque[Data] = deque(maxlen=_COPIES)
        self.begin()

    def begin(self) -> None:
        """As after it was opened."""
        self.decoder: Decoder
        match self.kind:
            case "serial":
                self.decoder = SerialDecoder()
            case "modbus-tcp" | "modbus-rtu":
                self.decoder = ModbusDecoder(over_tcp=self.kind == "modbus-tcp")
            case _:
                channels = {
                    address: max(side.plan.channels, default=0) + 1
                    for address, side in self.sides.items()
                }
                self.decoder = CanDecoder(self.kind, channels)


class Witness:
    """Watches the wires of a plan (see `sim.witness.plan`); times [s] are of any one clock.

    Bytes are all it needs. What it is told beside them makes more rules apply: contacts those about
    touches, wishes those about arming and stopping, levels those about silence where nobody asks.
    record is called with every piece of bytes as a line of a capture.
    """

    def __init__(
        self, plan: Mapping[str, Any] | Plan, *, record: Callable[[str], None] | None = None
    ) -> None:
        self._plan = plan if isinstance(plan, Plan) else plan_of(plan)
        self._report = Report()
        self._record = record
        self._now = -math.inf
        self.frames = 0
        self._sides: dict[str, Side] = {}
        self._wires: dict[str, _Wire] = {}
        for wire, kind in self._plan.wires.items():
            sides = {}
            for name, one in self._plan.amplifiers.items():
                if one.wire == wire:
                    sides[one.address] = self._sides[name] = self._side(name)
            self._wires[wire] = _Wire(kind, sides)
        self._host = Host(self._sides, times=self._plan.times)

    def _side(self, name: str) -> Side:
        plan = self._plan.amplifiers[name]

        def complain(invariant: str, time: float, sentence: str) -> None:
            self._report.add(invariant, plan.wire, time, sentence)

        def complain_unless_troubled(invariant: str, time: float, sentence: str) -> None:
            if not self._is_troubled(plan.wire):
                complain(invariant, time, sentence)

        follower = Follower(
            name,
            plan,
            times=self._plan.times,
            complain=complain_unless_troubled,
            insist=complain,
        )
        return Side(name, plan, follower, complain, lambda: self._is_troubled(plan.wire))

    @property
    def wires(self) -> tuple[str, ...]:
        """The names of the wires."""
        return tuple(self._wires)

    # what it is told

    def bytes(self, link: str, direction: Toward, time: float, data: Data) -> None:
        """Bytes have passed on a wire, toward the amplifier or the host."""
        self._pass_to(time)
        wire = self._wires[link]
        if self._record is not None:
            arrow = ">" if direction == "amplifier" else "<"
            self._record(f"{time:.6f} {link} {arrow} {data.hex()}")
        for raw, meaning in wire.decoder.feed(direction, time, data):
            self.frames += 1
            self._report.frame(link, time, direction, raw)
            if meaning is None:
                continue
            if direction == "amplifier":
                self._sent(link, wire, time, raw, meaning)
            else:
                self._said(link, wire, time, meaning)

    def opened(self, link: str, time: float) -> None:
        """A host has opened a wire: whoever answers there is not known yet."""
        self._pass_to(time)
        self._wires[link].begin()
        for side in self._wires[link].sides.values():
            side.is_open, side.is_identified, side.vibrates = True, False, False
            side.forget_pending()
            side.follower.lose_track()

    def closed(self, link: str, time: float) -> None:
        """The host has closed a wire, or lost it."""
        self._pass_to(time)
        for side in self._wires[link].sides.values():
            side.is_open = False
            if any(asked.kind in MOVING for _, asked in side.pending.values()):
                side.follower.lose_track()  # it may have carried out what nobody hears it answer
            side.forget_pending()
            side.stop_wished = side.last_life = None

    def contacts(
        self, time: float, contacts: Collection[Hashable], *, is_answerable: bool = True
    ) -> None:
        """These fingers, by any name, are on the plate from now on.

        is_answerable: whether a new one of them ought to get a pattern.
        """
        self._pass_to(time)
        self._host.contacts(time, contacts, is_answerable=is_answerable)

    def expect(self, expected: Expected | None) -> None:
        """What every pattern must be from now on, by amplifier and channel; None: any."""
        self._host.expect(expected)

    def wish(self, time: float, what: Wish) -> None:
        """Somebody wants the controller to do this, now."""
        self._pass_to(time)
        self._host.wish(time, what)

    def hang(self, time: float, is_hung: bool = True) -> None:
        """The control loop hangs from now on, or runs again."""
        self._pass_to(time)
        self._host.hang(time if is_hung else None)

    def faults(self, time: float, link: str, *, are_on: bool) -> None:
        """Faults are put on a wire or its amplifiers from now on, or no more."""
        self._pass_to(time)
        self._wires[link].troubled_until = math.inf if are_on else time + _RECOVERY
        if not are_on:  # what amplifiers did meanwhile need not have been seen
            for side in self._wires[link].sides.values():
                side.follower.lose_track()

    def levels(
        self,
        time: float,
        amplifier: str,
        levels: Sequence[float],
        *,
        frequencies: Mapping[int, float] | None = None,
    ) -> None:
        """What sensors find on the channels of an amplifier: levels, 1 is full stroke, and Hz."""
        self._pass_to(time)
        side = self._sides[amplifier]
        for channel, level in enumerate(levels):
            limits = side.plan.channels.get(channel)
            if level > (limits.level if limits is not None else 0.0) + 0.002:
                side.complain(
                    "limits", time, f"channel {channel} of {amplifier} has level {level:.4f}"
                )
        is_amid = any(asked.kind in MOVING for _, asked in side.pending.values())
        if not (is_amid or self._is_troubled(side.plan.wire)):
            side.follower.plays(levels, frequencies or {}, time)

    def finish(self, time: float | None = None) -> list[Violation]:
        """Everything that was wrong, in its order; time: until when it has watched [s]."""
        if time is not None:
            self._pass_to(time)
        return self._report.found

    # what passes

    def _pass_to(self, time: float) -> None:
        self._now = max(self._now, time)
        self._host.pass_to(self._now)
        for side in self._sides.values():
            side.follower.pass_to(self._now)
            self._look_for_overdue(side)

    def _is_troubled(self, wire: str) -> bool:
        return self._now <= self._wires[wire].troubled_until

    def _look_for_overdue(self, side: Side) -> None:
        times = self._plan.times
        for key, (at, asked) in list(side.pending.items()):
            if self._now > at + times.reply + times.slack and key not in side.overdue:
                side.overdue.add(key)
                if asked.kind in MOVING:
                    side.follower.lose_track()
                if not self._is_troubled(side.plan.wire):
                    what = f"{side.name} has not answered {asked.kind.value} of {at:.4f} s"
                    side.complain("answer", self._now, what)
            if self._now > at + _FORGOTTEN:
                side.overdue.discard(key)
                del side.pending[key]

    def _sent(self, link: str, wire: _Wire, time: float, raw: Data, meaning: Meaning) -> None:
        """A frame toward the amplifiers."""
        is_torn = isinstance(meaning, Asked) and meaning.problem.startswith("torn")
        is_copy = self._is_troubled(link) and (raw in wire.recent or is_torn)
        wire.recent.append(raw)
        if isinstance(meaning, Damaged):
            if not self._is_troubled(link):
                self._report.add("garbage", link, time, f"the host sent {meaning.why}")
            return
        if not isinstance(meaning, Asked):
            return
        sides = wire.sides.values() if meaning.address == 0 else ()
        alone = wire.sides.get(meaning.address)
        if alone is None and meaning.address == 255 and wire.kind == "modbus-tcp":
            alone = next(iter(wire.sides.values()), None)
        for side in (*sides, *((alone,) if alone is not None else ())):
            if not is_copy:
                self._host.asked(side, time, meaning)
            if meaning.key is None:
                self._unanswered(side, time, meaning)
            else:
                side.pending[meaning.key] = (time, meaning)
                side.overdue.discard(meaning.key)
                if not meaning.problem and meaning.kind is not Kind.LOOK:
                    self._may_feed(side, time, meaning)

    def _unanswered(self, side: Side, time: float, asked: Asked) -> None:
        """What nobody answers: a broadcast, a heartbeat of a host on CAN, a transfer of objects."""
        if asked.kind is Kind.PING and side.follower.state is not None:
            if self._is_troubled(side.plan.wire):
                side.follower.watchdog.may_be_fed(time)
            else:
                side.follower.fed(time)
        elif asked.kind is Kind.HELLO:
            self._host.granted(side, time, asked)
        elif asked.kind in (Kind.STOP, Kind.COMMIT):
            side.follower.announced(asked, time)
            self._host.granted(side, time, asked)

    def _may_feed(self, side: Side, time: float, asked: Asked) -> None:
        if asked.kind in MOVING or asked.kind is Kind.PING:
            side.follower.watchdog.may_be_fed(time)

    def _said(self, link: str, wire: _Wire, time: float, meaning: Meaning) -> None:
        """A frame toward the host."""
        if isinstance(meaning, Damaged):
            if not self._is_troubled(link):
                self._report.add("garbage", link, time, f"an amplifier sent {meaning.why}")
            return
        if isinstance(meaning, Asked):
            return
        side = wire.sides.get(meaning.address)
        if side is None and meaning.address == 255:
            side = next(iter(wire.sides.values()), None)
        if side is None:
            return
        if isinstance(meaning, Restarted):
            self._restarted(link, side, time)
        elif isinstance(meaning, Told):
            if not any(asked.kind in MOVING for _, asked in side.pending.values()):
                side.follower.told(meaning.state, meaning.fault, time)
        else:
            self._answered(link, side, time, meaning)

    def _restarted(self, link: str, side: Side, time: float) -> None:
        if side.follower.is_enabled and not self._is_troubled(link):
            side.complain("state", time, f"{side.name} has started anew while it was enabled")
        side.follower.restarted(time)
        side.vibrates = False

    def _answered(self, link: str, side: Side, time: float, answer: Answered) -> None:
        if answer.key == "objects":
            side.follower.watchdog.may_be_fed(time)
            return
        if answer.problem == ANSWERS_DAMAGE:
            side.complain("damage", time, f"{side.name} carries out and answers a damaged frame")
            return
        at, asked = side.pending.pop(answer.key, (math.inf, None))
        if asked is None:
            was_abandoned = answer.key in side.abandoned
            side.abandoned.discard(answer.key)
            if not (was_abandoned or self._is_troubled(link)):
                why = f": {answer.problem}" if answer.problem else ""
                what = f"{side.name} answers what nobody has asked it, or asks no more{why}"
                side.complain("credit", time, what)
            return
        if answer.problem and not self._is_troubled(link):
            side.complain(
                "answer", time, f"an answer of {side.name} is not whole: {answer.problem}"
            )
        was_lost = answer.key in side.overdue
        side.overdue.discard(answer.key)
        if answer.refusal:
            self._host.refused(time, asked)
            side.follower.watchdog.was_not_fed()
        elif asked.problem:
            rule = "commit" if asked.problem.startswith("torn") else "garbage"
            side.complain(rule, time, f"{side.name} took {asked.kind.value}: {asked.problem}")
        if asked.kind is Kind.HELLO:
            self._host.granted(side, time, asked)
        if was_lost or asked.problem:
            return
        if answer.refusal:
            if answer.condition is not None:
                side.follower.said(answer.condition, at, time)
            return
        if asked.kind in MOVING:
            # It may have been carried out when it was asked first, and that answer was lost.
            same = [before for before, one in side.pending.values() if _is_repeated(one, asked)]
            at = min([at, *same])
        self._host.granted(side, time, asked)
        if self._is_troubled(link) and asked.kind is Kind.ARM:
            side.follower.lose_track()
        side.follower.granted(asked, answer, at, time)


def _is_repeated(asked: Asked, again: Asked) -> bool:
    """Whether a request is another one once more, as a host repeats it."""
    return asked.kind is again.kind and asked.token == again.token
