"""Which answer belongs to which request, and what the two of them mean together."""

import math

from sim.witness.host import Host
from sim.witness.plan import Times
from sim.witness.seen import (
    ANSWERS_DAMAGE,
    MOVING,
    Answered,
    Asked,
    Damaged,
    Data,
    Kind,
    Meaning,
    Restarted,
    Told,
    Toward,
)
from sim.witness.side import Side
from sim.witness.violation import Report
from sim.witness.wire import Wire

_FORGOTTEN = 1.0  # s; an answer that comes later was meant for nobody


class Exchanges:
    """The frames of all wires, as they are seen one by one.

    host is told what it has asked and was granted, the follower of each amplifier what that did.
    """

    def __init__(self, host: Host, *, times: Times, report: Report) -> None:
        self._host = host
        self._times = times
        self._report = report

    def look_for_overdue(self, side: Side, now: float) -> None:
        """Complain of answers that ought to be there by now."""
        for key, (at, asked) in list(side.pending.items()):
            due = at + self._times.reply + self._times.slack
            if now > due and key not in side.overdue:
                side.overdue.add(key)
                if asked.kind in MOVING:
                    side.follower.lose_track()
                if not side.is_troubled(due):
                    what = f"{side.name} has not answered {asked.kind.value} of {at:.4f} s"
                    side.complain("answer", now, what)
            if now > at + _FORGOTTEN:
                side.overdue.discard(key)
                side.settled.discard(key)
                del side.pending[key]

    def sent(self, wire: Wire, time: float, raw: Data, meaning: Meaning) -> None:
        """A frame toward the amplifiers."""
        is_torn = isinstance(meaning, Asked) and meaning.problem.startswith("torn")
        is_copy = wire.is_troubled(time) and (raw in wire.recent or is_torn)
        wire.recent.append(raw)
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
                side.settled.discard(meaning.key)
                if not meaning.problem and meaning.kind is not Kind.LOOK:
                    self._may_feed(side, time, meaning)

    def damaged(
        self, wire: Wire, time: float, toward: Toward, damaged: Damaged, *, begun: float
    ) -> None:
        """A frame that is none; begun [s]: when the first of it has passed, maybe amid trouble."""
        if not wire.is_troubled(begun):
            who = "the host" if toward == "amplifier" else "an amplifier"
            self._report.add("garbage", wire.name, time, f"{who} sent {damaged.why}")

    def _unanswered(self, side: Side, time: float, asked: Asked) -> None:
        """What nobody answers: a broadcast, a heartbeat of a host on CAN, a transfer of objects."""
        if asked.kind is Kind.PING and side.follower.state is not None:
            if side.is_troubled(time):
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

    def said(self, wire: Wire, time: float, meaning: Meaning) -> None:
        """A frame toward the host."""
        if isinstance(meaning, Asked | Damaged):
            return
        side = wire.sides.get(meaning.address)
        if side is None and meaning.address == 255:
            side = next(iter(wire.sides.values()), None)
        if side is None:
            return
        if isinstance(meaning, Restarted):
            self._restarted(side, time)
        elif isinstance(meaning, Told):
            if not any(asked.kind in MOVING for _, asked in side.pending.values()):
                side.follower.told(meaning.state, meaning.fault, time)
        else:
            self._answered(side, time, meaning)

    def _restarted(self, side: Side, time: float) -> None:
        if side.follower.is_enabled and not side.is_troubled(time):
            side.complain("state", time, f"{side.name} has started anew while it was enabled")
        side.follower.restarted(time)
        side.vibrates = False

    def _answered(self, side: Side, time: float, answer: Answered) -> None:
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
            if not (was_abandoned or side.is_troubled(time)):
                why = f": {answer.problem}" if answer.problem else ""
                what = f"{side.name} answers what nobody has asked it, or asks no more{why}"
                side.complain("credit", time, what)
            return
        if answer.problem and not side.is_troubled(time):
            side.complain(
                "answer", time, f"an answer of {side.name} is not whole: {answer.problem}"
            )
        was_lost = answer.key in side.overdue or answer.key in side.settled
        side.overdue.discard(answer.key)
        side.settled.discard(answer.key)
        if answer.refusal:
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
            same = {
                key: before
                for key, (before, one) in side.pending.items()
                if _is_repeated(one, asked)
            }
            at = min([at, *same.values()])
            side.settled.update(same)
        self._host.granted(side, time, asked)
        if side.is_troubled(time) and asked.kind is Kind.ARM:
            side.follower.lose_track()
        side.follower.granted(asked, answer, at, time)


def _is_repeated(asked: Asked, again: Asked) -> bool:
    """Whether a request is another one once more, as a host repeats it."""
    return asked.kind is again.kind and asked.token == again.token
