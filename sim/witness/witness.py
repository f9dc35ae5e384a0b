"""The witness: bytes of every wire in, broken rules out; it reads no clock, waits for nothing."""

import math
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from typing import Any, Literal

from sim.witness.exchanges import Exchanges
from sim.witness.follower import Follower
from sim.witness.host import Host
from sim.witness.plan import Plan, plan_of
from sim.witness.seen import MOVING, Damaged, Data, Toward
from sim.witness.set_rules import Expected
from sim.witness.side import Side
from sim.witness.violation import Report, Violation
from sim.witness.wire import Wire

OperatorCommand = Literal["arm", "disarm", "stop", "clear"]


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
        self._wires: dict[str, Wire] = {}
        for wire, kind in self._plan.wires.items():
            sides = {}
            for name, one in self._plan.amplifiers.items():
                if one.wire == wire:
                    sides[one.address] = self._sides[name] = self._side(name)
            self._wires[wire] = Wire(wire, kind, sides)
        times = self._plan.times
        self._host = Host(self._sides, times=times)
        self._exchanges = Exchanges(self._host, times=times, report=self._report)

    def _side(self, name: str) -> Side:
        plan = self._plan.amplifiers[name]

        def complain(invariant: str, time: float, sentence: str) -> None:
            self._report.add(invariant, plan.wire, time, sentence)

        def is_troubled(time: float) -> bool:
            return self._wires[plan.wire].is_troubled(time)

        def complain_unless_troubled(invariant: str, time: float, sentence: str) -> None:
            if not is_troubled(self._now):
                complain(invariant, time, sentence)

        follower = Follower(
            name,
            plan,
            times=self._plan.times,
            complain=complain_unless_troubled,
            insist=complain,
        )
        return Side(name, plan, follower, complain, is_troubled)

    @property
    def wires(self) -> tuple[str, ...]:
        """The names of the wires."""
        return tuple(self._wires)

    def bytes(self, link: str, direction: Toward, time: float, data: Data) -> None:
        """Bytes have passed on a wire, toward the amplifier or the host."""
        self._pass_to(time)
        wire = self._wires[link]
        if self._record is not None:
            arrow = ">" if direction == "amplifier" else "<"
            self._record(f"{time:.6f} {link} {arrow} {data.hex()}")
        for begun, (raw, meaning) in wire.feed(direction, time, data):
            self.frames += 1
            self._report.frame(link, time, direction, raw)
            if meaning is None:
                continue
            if isinstance(meaning, Damaged):
                self._exchanges.damaged(wire, time, direction, meaning, begun=begun)
            if direction == "amplifier":
                self._exchanges.sent(wire, time, raw, meaning)
            else:
                self._exchanges.said(wire, time, meaning)

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

    def wish(self, time: float, what: OperatorCommand) -> None:
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
        self._wires[link].trouble(time, is_on=are_on)
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
        if not (is_amid or side.is_troubled(time)):
            side.follower.plays(levels, frequencies or {}, time)

    def finish(self, time: float | None = None) -> list[Violation]:
        """Everything that was wrong, in its order; time: until when it has watched [s]."""
        if time is not None:
            self._pass_to(time)
        return self._report.found

    def _pass_to(self, time: float) -> None:
        self._now = max(self._now, time)
        self._host.pass_to(self._now)
        for side in self._sides.values():
            side.follower.pass_to(self._now)
            self._exchanges.look_for_overdue(side, self._now)
