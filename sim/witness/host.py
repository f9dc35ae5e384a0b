"""What a host may send: to each amplifier, for those who touch, and for whoever arms and stops it.

These rules are checked as a frame passes; what it owes within a time is in `duties`.
"""

from collections.abc import Collection, Hashable, Mapping

from sim.witness.duties import Duties
from sim.witness.people import People
from sim.witness.plan import Times
from sim.witness.seen import FEEDING, Asked, Drive, Kind
from sim.witness.set_rules import Expected, check_set, check_shape
from sim.witness.side import Side

_SETS = (Kind.APPLY, Kind.STAGE)
_BEGUN = 0.020  # s; for so long what was wished first may go before what was wished next
_UNCOUNTED = (Kind.LOOK, Kind.HELLO, Kind.CAPABILITIES)


class Host:
    """The rules about hosts, over all amplifiers of a plan."""

    def __init__(self, sides: Mapping[str, Side], *, times: Times) -> None:
        self._sides = sides
        self._times = times
        self._people = People()
        self._duties = Duties(sides, self._people, times=times)
        self._expected: Expected | None = None

    # what the witness is told beside the wires

    def contacts(self, time: float, contacts: Collection[Hashable], *, is_answerable: bool) -> None:
        """These fingers are on the plate from now on."""
        was_touched = bool(self._people.contacts)
        come = self._people.touch(time, contacts)
        if was_touched and not self._people.contacts:
            self._duties.silence(time)
        if is_answerable:
            for contact in come:
                self._duties.pattern(contact, time)

    def expect(self, expected: Expected | None) -> None:
        """What every pattern must be from now on; None: any."""
        self._expected = expected

    def wish(self, time: float, what: str) -> None:
        """Somebody wants it to arm, disarm, stop or clear."""
        self._people.wish(time, what)
        if what == "stop":
            for side in self._sides.values():
                if side.is_open and not side.is_troubled(time):
                    self._duties.stop(side, time)

    def hang(self, time: float | None) -> None:
        """The control loop hangs from a time [s] on; None: it runs again."""
        self._people.hung = time
        if time is None:
            for side in self._sides.values():
                side.last_life = None  # it owes the next after it has run

    # what it sends

    def asked(self, side: Side, time: float, asked: Asked) -> None:
        """A request to one amplifier; a broadcast is one to each."""
        if asked.problem:
            rule = "commit" if asked.problem.startswith("torn") else "garbage"
            side.complain(rule, time, f"the host sent {asked.kind.value}: {asked.problem}")
        if asked.key is not None:
            self._check_credit(side, time, asked)
        self._check_stop(side, time, asked)
        if asked.kind in FEEDING:
            self._check_life(side, time, asked)
        if asked.kind is Kind.ARM:
            self._check_arm(side, time)
        if asked.kind in _SETS:
            self._check_set(side, time, asked)
        if asked.kind is Kind.ENVELOPE and asked.shape is not None:
            check_shape(side, time, max(asked.shape.levels, default=0.0))
        self._note(side, time, asked)

    def granted(self, side: Side, time: float, asked: Asked) -> None:
        """A request of it was not refused."""
        match asked.kind:
            case Kind.HELLO:
                side.is_identified = True
            case Kind.ARM:
                if side.is_stopped:
                    what = f"{side.name} is armed although its stop is not cleared"
                    side.complain("stop", time, what)
                side.tokens.clear()
                side.armed_at = time
                side.last_life = time
            case Kind.CLEAR:
                side.is_stopped = False
            case Kind.APPLY | Kind.COMMIT:
                if self._vibrates(side, asked):
                    side.vibrated_at = time

    def pass_to(self, time: float) -> None:
        """Look at what was to be done by now."""
        self._duties.pass_to(time)
        for side in self._sides.values():
            self._check_pulse(side, time)
            if side.follower.faulted_at > self._people.wished and self._people.arm_wished:
                self._people.arm_wished = False  # a fault ends what was wished before it

    # rules

    def _check_credit(self, side: Side, time: float, asked: Asked) -> None:
        """Nothing is asked while something else may still be answered, but for silence."""
        if self._silences(asked):
            side.overtaken = time  # what it overtakes is waited for no more
            return
        for at, other in side.pending.values():
            # After a last lift it is waited for no more, though a finger may have come since.
            if (
                at > max(side.overtaken, self._people.lifted)
                and time - at < self._times.reply - self._times.slack
            ):
                side.complain(
                    "credit",
                    time,
                    f"the host asked {side.name} {asked.kind.value} {(time - at) * 1e3:.1f} ms "
                    f"after {other.kind.value}, which nobody has answered: it took something else "
                    "for the answer",
                )

    def _check_stop(self, side: Side, time: float, asked: Asked) -> None:
        is_other = asked.kind is not Kind.STOP and asked.kind not in _UNCOUNTED
        # What was asked before it, at the same moment, may go before it.
        if side.stop_wished is not None and time > side.stop_wished and is_other:
            if asked.kind is Kind.DISARM and side.stop_wished < self._people.disarm_wished + _BEGUN:
                return  # which silences as well
            side.complain(
                "stop",
                time,
                f"a stop was wished at {side.stop_wished:.4f} s, but the next that {side.name} was "
                f"told is {asked.kind.value}",
            )
            side.stop_wished = None

    def _check_life(self, side: Side, time: float, asked: Asked) -> None:
        hung = self._people.hung
        is_by_loop = asked.kind in (Kind.PING, Kind.COMMIT, Kind.STAGE) or asked.vibrates
        if hung is not None and time > hung + self._times.slack and is_by_loop:
            side.complain(
                "heartbeat",
                time,
                f"the control loop hangs since {hung:.4f} s, but {side.name} is sent "
                f"{asked.kind.value}, which feeds its watchdog",
            )
        side.last_life = time

    def _check_pulse(self, side: Side, time: float) -> None:
        if side.is_troubled(time):
            side.last_life = None  # who has given an amplifier up owes it nothing
        last = side.last_life
        is_ending = (
            self._people.silence_wished >= side.armed_at
        )  # heartbeats would only be in the way
        is_running = self._people.hung is None and not is_ending
        is_owed = side.is_open and side.follower.is_enabled and is_running
        if last is None or not is_owed:
            return
        if time > last + self._times.heartbeat + self._times.slack:
            side.last_life = time
            side.complain(
                "heartbeat", time, f"{side.name} has had no sign of life since {last:.4f} s"
            )

    def _check_arm(self, side: Side, time: float) -> None:
        # What was begun may be sent yet, and is followed by what withdraws it.
        is_withdrawn = time > self._people.silence_wished + self._times.stop
        if self._people.arm_wished is False and is_withdrawn:
            side.complain("armed", time, f"{side.name} is armed although nobody wished it")
        if side.is_identified is False:
            side.complain("identified", time, f"{side.name} is armed without being asked who it is")

    def _check_set(self, side: Side, time: float, asked: Asked) -> None:
        check_set(side, time, asked, self._expected)
        if asked.vibrates:
            self._check_justified(side, time)

    def _check_justified(self, side: Side, time: float) -> None:
        if side.is_stopped:
            side.complain("stop", time, f"{side.name} is told to vibrate after its stop")
        elif self._knows_of_disarmed(side):
            side.complain(
                "enabled", time, f"{side.name} is told to vibrate although it is not enabled"
            )
        is_touched = self._people.contacts is None or self._people.contacts
        if not is_touched and time > self._people.lifted + self._times.lift + self._times.slack:
            side.complain(
                "justified",
                time,
                f"{side.name} is told to vibrate although nobody touches the plate since "
                f"{self._people.lifted:.4f} s",
            )

    def _knows_of_disarmed(self, side: Side) -> bool:
        """Whether an amplifier is not enabled, and an answer has said so, or the host has done it.

        A fault that it tells unasked may be on its way while a set goes to it, which it refuses.
        """
        follower = side.follower
        is_enabled = follower.state is None or follower.is_enabled
        return not is_enabled and (follower.is_answered or not follower.is_in_fault)

    # what is remembered

    def _note(self, side: Side, time: float, asked: Asked) -> None:
        match asked.kind:
            case Kind.STAGE:
                side.staged = {asked.token: asked}
            case Kind.APPLY | Kind.COMMIT:
                is_new = asked.token != side.last_token
                side.told.append(asked.token)
                drives = self._drives(side, asked)
                side.vibrates = self._vibrates(side, asked)
                side.last_token = asked.token
                side.levels = {channel: drive for channel, drive in drives.items() if drive.level}
                if is_new and side.vibrates:
                    self._duties.company(side, time, asked.token)
                if not side.vibrates:
                    side.silenced_at = time
                    self._check_release(side, time, asked.ramp, drives)
            case Kind.STOP | Kind.DISARM | Kind.ARM:
                side.vibrates = False
                side.silenced_at = time
                side.levels = {}
                side.staged = {}
                if asked.kind is Kind.STOP:
                    side.is_stopped, side.stop_wished = True, None
                    if self._people.arm_wished:
                        self._people.arm_wished, self._people.silence_wished = False, time
            case _:
                pass

    def _check_release(
        self, side: Side, time: float, ramp: float, drives: Mapping[int, Drive]
    ) -> None:
        """Zero itself, not only its command, is there soon after the last lift."""
        if self._people.contacts or not 0 <= time - self._people.lifted <= self._times.lift:
            return
        has_endings = any(not drive.skip_ending for drive in drives.values()) and side.staged
        if (
            time + ramp > self._people.lifted + self._times.release + self._times.slack
            and not has_endings
        ):
            side.complain(
                "lift",
                time,
                f"the last finger was lifted at {self._people.lifted:.4f} s, but {side.name} is "
                f"silent only after a ramp of {ramp:g} s",
            )

    def _drives(self, side: Side, asked: Asked) -> Mapping[int, Drive]:
        if asked.kind is Kind.COMMIT:
            staged = side.staged.get(asked.token)
            return staged.drives if staged is not None else side.levels
        return asked.drives

    def _vibrates(self, side: Side, asked: Asked) -> bool:
        return any(drive.vibrates for drive in self._drives(side, asked).values())

    def _silences(self, asked: Asked) -> bool:
        is_silent_set = asked.kind is Kind.APPLY and not asked.vibrates
        return is_silent_set or asked.kind in (Kind.STOP, Kind.DISARM)
