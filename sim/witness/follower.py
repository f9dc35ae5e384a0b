"""Follows one amplifier by the documented protocol, and says where it does something else.

State, fault, active set, watchdog and levels are known within the time between a request and its
answer, and what is said about them holds for all of that time.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence

from sim.witness.fade import Fade
from sim.witness.plan import AmplifierPlan, Times
from sim.witness.seen import FEEDING, Answered, Asked, Condition, Drive, Kind

SILENCING_RAMP = 0.005  # s; along which the watchdog and faults silence
_LEVEL = 0.002  # of full stroke; what rounding and the last bit of a fade may make
_LEFT = 0.003  # s; the same of the watchdog's time
_FINE = 0.011  # Hz and degrees; one step of the wire
_REMEMBERED = 16  # tokens since Arm
_WARM = 60.0  # °C; from here on an amplifier may play less than it was told
_ENABLED, _STOPPED, _REACTING, _FAULT = 4, 5, 6, 7
_OFF = (0, 1, 2)
_LATCHED = (_STOPPED, _REACTING, _FAULT)
_SILENT = (*_OFF, _FAULT)  # in which no level may be left

Complain = Callable[[str, float, str], None]
"""Is told of a broken rule: its name, when [s], one sentence."""

NAMES = (
    "NOT_READY",
    "SWITCH_ON_DISABLED",
    "READY_TO_SWITCH_ON",
    "SWITCHED_ON",
    "OPERATION_ENABLED",
    "QUICK_STOP_ACTIVE",
    "FAULT_REACTION_ACTIVE",
    "FAULT",
)


class Follower:
    """What one amplifier must be doing. state: None while nobody knows."""

    def __init__(self, name: str, plan: AmplifierPlan, *, times: Times, complain: Complain) -> None:
        self._name = name
        self._plan = plan
        self._slack = times.slack
        self._complain = complain
        self.state: int | None = None
        self._fault = 0
        self._is_reported = True  # the state, by the amplifier itself
        self._watchdog = math.inf
        self._fed = (-math.inf, math.inf)
        self._fed_before = math.inf
        self._seen_at = -math.inf  # when it last said how it is
        self._token: int | None = None
        self._played: deque[int] = deque(maxlen=_REMEMBERED)
        self._staged: Asked | None = None
        self._cause = "nothing"
        self._fades: dict[int, Fade] = {}
        self._drives: Mapping[int, Drive] = {}
        self._levels_before: Mapping[int, float] = {}
        self._endings: dict[int, int] = {}
        self._durations: dict[int, float] = {}  # of envelopes, by slot
        self._ends: tuple[float, float] | None = None
        self._ramp = 0.0
        self._is_warm = False
        # Of sensors that find too little, while it may be in a fault of its own that nobody knows.
        self._suspicions: list[tuple[str, float, str]] = []

    @property
    def is_enabled(self) -> bool:
        """Whether it is armed, as far as anybody knows."""
        return self.state == _ENABLED

    @property
    def is_in_fault(self) -> bool:
        """Whether it is in a fault of its own, or of its watchdog."""
        return self.state in (_REACTING, _FAULT)

    def lose_track(self) -> None:
        """What it does now is not known until it says so."""
        self.state = self._token = None
        self._fed = (-math.inf, math.inf)
        self._ends = None
        self._staged = None
        self._free(math.inf)

    def restarted(self, time: float) -> None:
        """It has got its supply anew: disarmed and silent."""
        self.lose_track()
        self.state, self._token, self._cause = 1, 0, "its restart"
        self._fades = {}
        self._seen_at = time

    def fed(self, time: float) -> None:
        """Its watchdog was filled."""
        if self.state == _ENABLED:
            self._fed = (time, time)

    def may_be_fed(self, time: float) -> None:
        """Something may have filled its watchdog; `was_not_fed` takes that back."""
        self._fed_before = self._fed[1]
        self._fed = (self._fed[0], max(self._fed[1], time))

    def was_not_fed(self) -> None:
        """What may have filled its watchdog was refused."""
        self._fed = (self._fed[0], self._fed_before)

    def pass_to(self, time: float) -> None:
        """Let happen what it must have done by itself until now."""
        if self._ends is not None and time > self._ends[1] + self._slack:
            begin, self._ends = self._ends, None
            durations = [self._duration(slot) for slot in self._endings.values()]
            self._silence(begin, self._ramp, "the end of valid_for", free=max(durations, default=0))
        if self.state == _ENABLED and time > self._fed[1] + self._watchdog + self._slack:
            begin = (self._fed[0] + self._watchdog, self._fed[1] + self._watchdog)
            self._silence(begin, SILENCING_RAMP, "the watchdog")
            self.state, self._fault, self._is_reported = _REACTING, 1, False

    # what it grants

    def granted(self, asked: Asked, answer: Answered, begin: float, end: float) -> None:
        """A request that was seen at `begin` was not refused, as is known at `end`."""
        self.pass_to(begin)
        self._check_state_allows(asked, end)
        if asked.kind in FEEDING:
            self._fed = (begin, end)
        match asked.kind:
            case Kind.ARM:
                self._silence((begin, end), SILENCING_RAMP, "Arm")
                self.state, self._fault, self._token = _ENABLED, 0, 0
                self._watchdog = asked.watchdog
                self._played.clear()
            case Kind.DISARM | Kind.STOP:
                self._stopped(asked, begin, end)
            case Kind.STAGE:
                self._staged = asked
                self._check_achieved(asked, answer, end)
            case Kind.APPLY:
                self._check_achieved(asked, answer, end)
                self._applied(asked, answer, begin, end)
            case Kind.COMMIT:
                self._committed(asked, answer, begin, end)
            case Kind.CLEAR if self.state in (_STOPPED, _FAULT, _REACTING):
                self._cleared(answer)
            case Kind.ENVELOPE if asked.shape is not None:
                shape = asked.shape
                self._durations[shape.slot] = shape.step * (len(shape.levels) + 1)
            case _:
                pass
        if answer.condition is not None:
            self.said(answer.condition, begin, end)

    def announced(self, asked: Asked, time: float) -> None:
        """A broadcast that it may follow; nobody answers."""
        self.pass_to(time)
        if self.state is None:
            return
        self.may_be_fed(time)
        soon = (time, time + 0.010)  # as an answer would take
        if asked.kind is Kind.STOP:
            self._stopped(asked, *soon)
        elif (
            asked.kind is Kind.COMMIT
            and self._staged is not None
            and asked.token == self._staged.token
            and self.state == _ENABLED
        ):
            self._play(self._staged, self._staged.drives, *soon)

    def _check_state_allows(self, asked: Asked, end: float) -> None:
        sets = (Kind.STAGE, Kind.COMMIT, Kind.APPLY)
        if asked.kind in sets and self.state not in (None, _ENABLED):
            overdue = not self._is_reported
            self._complain(
                "watchdog" if overdue else "enabled",
                end,
                f"{self._name} took a set although it must be in {self._named()}",
            )
        if asked.kind is Kind.ARM and self.state in _LATCHED and self._is_reported:
            self._complain("latched", end, f"{self._name} let itself be armed in {self._named()}")

    def _stopped(self, asked: Asked, begin: float, end: float) -> None:
        self._silence((begin, end), asked.ramp, asked.kind.value)
        if asked.kind is Kind.STOP:
            self.state = self.state if self.state in (_REACTING, _FAULT) else _STOPPED
        elif self.state == _ENABLED:
            self.state = 3

    def _cleared(self, answer: Answered) -> None:
        """It may stay as it is, or go to disarmed."""
        said = answer.condition
        if said is None:
            self.state = None
        elif said.state in _OFF and not (self.state == _REACTING and self._is_reported):
            self.state, self._fault, self._cause = 1, 0, "Clear"

    def _committed(self, asked: Asked, answer: Answered, begin: float, end: float) -> None:
        if asked.token == self._token:
            return
        if self._staged is None or self._staged.token != asked.token:
            if self.state is not None:
                self._complain(
                    "token", end, f"{self._name} played set {asked.token}, which is not staged"
                )
            self.lose_track()
            return
        self._check_achieved(self._staged, answer, end)
        self._applied(self._staged, answer, begin, end)

    def _applied(self, asked: Asked, answer: Answered, begin: float, end: float) -> None:
        if asked.token == self._token:
            return
        if asked.token in self._played:
            self._complain(
                "token", end, f"{self._name} took set {asked.token} a second time after others"
            )
        drives = answer.achieved if answer.achieved is not None else asked.drives
        self._play(asked, drives, begin, end)
        if answer.is_as_asked is False and answer.achieved is None:
            self._free(math.inf)  # only an object tells what it plays

    def _play(self, asked: Asked, drives: Mapping[int, Drive], begin: float, end: float) -> None:
        self._token, self._staged = asked.token, None
        self._played.append(asked.token)
        self._levels_before = {channel: fade.after for channel, fade in self._fades.items()}
        for channel in {*self._plan.channels, *drives, *self._fades}:
            drive = drives.get(channel)
            level = drive.level if drive is not None else 0.0
            fade = self._fades.get(channel, Fade()).to(level, begin=(begin, end), ramp=asked.ramp)
            shaped = self._shaping(channel, drive)
            self._fades[channel] = fade._replace(free_until=end + shaped) if shaped else fade
        self._drives, self._cause, self._ramp = drives, "set", asked.ramp
        self._endings = {channel: drive.ending for channel, drive in drives.items() if drive.ending}
        ends = asked.valid_for > 0
        self._ends = (begin + asked.valid_for, end + asked.valid_for) if ends else None

    def _shaping(self, channel: int, drive: Drive | None) -> float:
        """How long an envelope shapes what a channel does now [s]; 0 for none."""
        if drive is not None and drive.onset:
            return self._duration(drive.onset)
        is_silent = drive is None or drive.level == 0
        skips = drive is not None and drive.skip_ending
        if is_silent and not skips and channel in self._endings:
            return self._duration(self._endings[channel])
        return 0.0

    def _duration(self, slot: int) -> float:
        return self._durations.get(slot, 33 * 0.1)  # the longest there is

    def _silence(
        self, begin: tuple[float, float], ramp: float, cause: str, *, free: float = 0.0
    ) -> None:
        for channel in {*self._plan.channels, *self._fades}:
            fade = self._fades.get(channel, Fade()).to(0.0, begin=begin, ramp=ramp)
            self._fades[channel] = fade._replace(free_until=begin[1] + free) if free else fade
        self._drives, self._cause = {}, cause
        self._staged = self._ends = None
        self._endings = {}

    def _free(self, until: float) -> None:
        for channel in {*self._plan.channels, *self._fades}:
            fade = self._fades.get(channel, Fade())
            self._fades[channel] = fade._replace(free_until=until, before=(0.0, 1.0))

    def _check_achieved(self, asked: Asked, answer: Answered, time: float) -> None:
        """What it says that a set plays is the set: whole, and no channel more than another."""
        if answer.token != asked.token and answer.token:
            what = f"{self._name} answered set {asked.token} with set {answer.token}"
            self._complain("credit", time, what)
        if answer.achieved is None:
            return
        if answer.achieved.keys() != asked.drives.keys():
            self._complain(
                "commit",
                time,
                f"{self._name} plays channels {sorted(answer.achieved)} of a set that names "
                f"{sorted(asked.drives)}",
            )
            return
        shares = []
        for channel, drive in asked.drives.items():
            played = answer.achieved[channel]
            turn = math.remainder(played.phase - drive.phase, 360.0)
            if drive.level > 0:
                shares.append(played.level / drive.level)
            is_other = (drive.level == 0) != (played.level == 0)
            if drive.level > 0 and (
                abs(played.frequency - drive.frequency) > _FINE or abs(turn) > _FINE
            ):
                is_other = True
            if is_other:
                self._complain(
                    "plays",
                    time,
                    f"{self._name} makes {played.frequency:g} Hz, level {played.level:g}, "
                    f"{played.phase:g} degrees of {drive.frequency:g} Hz, {drive.level:g}, "
                    f"{drive.phase:g} on channel {channel}",
                )
        if shares and max(shares) - min(shares) > 0.01:
            what = f"{self._name} plays the channels of a set at different shares of their levels"
            self._complain("commit", time, what)
        elif shares and not self._is_warm and abs(shares[0] - 1) > 0.01:
            self._complain(
                "plays", time, f"{self._name} plays {shares[0]:.3g} of the levels it was told"
            )

    # what it says

    def said(self, condition: Condition, begin: float, end: float) -> None:
        """How it says it is, at some time between two [s]."""
        self.pass_to(begin)
        if condition.temperature is not None:
            self._is_warm = condition.temperature >= _WARM
        self._check_condition(condition, begin, end)
        self._seen_at = end

    def told(self, state: int, fault: int, time: float) -> None:
        """What it says unasked."""
        self.said(Condition(state, fault), time, time)

    def _check_condition(self, said: Condition, begin: float, end: float) -> None:
        if self.state is None:
            self._adopt(said, end)
        else:
            self._check_state(said, begin, end)
        if said.token is not None:
            if self._token not in (None, said.token):
                self._complain(
                    "token",
                    end,
                    f"{self._name} says that set {said.token} plays, but the last that it took is "
                    f"{self._token}",
                )
            self._token = said.token
        if said.watchdog_left is not None:
            self._check_left(said, begin, end)
        if said.levels is not None:
            self._check_levels(said.levels, begin, end)
        if said.high_voltage is not None:
            must = {_ENABLED: True, _FAULT: False, **dict.fromkeys(_OFF, False)}.get(said.state)
            if must is not None and must != said.high_voltage:
                what = "off" if must else "on"
                self._complain(
                    "high_voltage",
                    end,
                    f"{self._name} has its high voltage {what} in {NAMES[said.state]}",
                )

    def _adopt(self, said: Condition, time: float) -> None:
        """The first that is known of it."""
        self.state, self._fault, self._is_reported = said.state, said.fault, True
        if said.state in _SILENT:
            self._fades, self._cause = {}, f"{NAMES[said.state]}"
        else:
            self._free(math.inf)
            self._fed = (-math.inf, time)

    def _check_state(self, said: Condition, begin: float, end: float) -> None:
        here, now = self.state, said.state
        trips = now in (_REACTING, _FAULT) and here not in (None, *_OFF, _REACTING, _FAULT)
        follows = {
            3: (3, 1),
            _REACTING: (_REACTING, _FAULT),
            **dict.fromkeys(_OFF, _OFF),
        }.get(here or 0, (here,))
        if trips:
            self._check_trip(said, end)
        elif now not in follows:
            self._complain(self._rule_against(now), end, self._what_is_wrong(now))
        elif now in _LATCHED and self._fault and said.fault != self._fault:
            self._complain(
                "latched", end, f"{self._name} was in fault {self._fault}, now it says {said.fault}"
            )
        if now in (_REACTING, _FAULT):
            self._fault = said.fault
        else:
            for suspicion in self._suspicions:
                self._complain(*suspicion)
        self._suspicions.clear()
        self.state, self._is_reported = now, True

    def _check_trip(self, said: Condition, end: float) -> None:
        """A fault of its own, or the watchdog, not before its time."""
        earliest = self._fed[0] + self._watchdog
        since = (min(self._seen_at, end), end)
        if said.fault == 1:
            if end < earliest - self._slack:
                self._complain(
                    "watchdog",
                    end,
                    f"{self._name}'s watchdog ran out {end - self._fed[0]:.4f} s after it was fed, "
                    f"but it was set to {self._watchdog:g} s",
                )
            since = (min(max(earliest, self._seen_at), end), end)
        elif said.fault == 0:
            self._complain("state", end, f"{self._name} is in {NAMES[said.state]} without a fault")
        self._silence(since, SILENCING_RAMP, "a fault")

    def _rule_against(self, now: int) -> str:
        if not self._is_reported:
            return "watchdog" if now == _ENABLED else "latched"
        if now == _ENABLED:
            return "armed"
        return "latched" if self.state in _LATCHED else "state"

    def _what_is_wrong(self, now: int) -> str:
        if not self._is_reported and now == _ENABLED:
            return (
                f"{self._name} is still enabled although it was fed last at {self._fed[1]:.4f} s "
                f"and its watchdog is set to {self._watchdog:g} s"
            )
        return f"{self._name} must be in {self._named()}, but it says {NAMES[now]}"

    def _check_left(self, said: Condition, begin: float, end: float) -> None:
        left = said.watchdog_left or 0.0
        if said.state == _ENABLED and self._watchdog < math.inf:
            low = self._watchdog - (end - self._fed[0]) - _LEFT
            high = self._watchdog - max(0.0, begin - self._fed[1]) + _LEFT
            if not low <= left <= high:
                self._complain(
                    "watchdog",
                    end,
                    f"{self._name} says its watchdog has {left:g} s left; it must be {low:.3f} to "
                    f"{high:.3f} s, for it was set to {self._watchdog:g} s and fed at "
                    f"{self._fed[0]:.4f} s",
                )
        elif said.state in _OFF and left:
            self._complain("watchdog", end, f"{self._name}'s watchdog runs while it is disarmed")

    # what it plays

    def plays(self, levels: Sequence[float], frequencies: Mapping[int, float], time: float) -> None:
        """What a sensor finds on its channels: levels, and where it is known the frequency [Hz]."""
        self.pass_to(time)
        self._check_levels(levels, time, time, of_sensor=True)
        for channel, frequency in frequencies.items():
            drive = self._drives.get(channel)
            is_settled = time > self._fades.get(channel, Fade()).settled_from
            is_told = drive is not None and drive.level > 0 and is_settled
            if drive is not None and is_told and abs(frequency - drive.frequency) > _FINE:
                self._complain(
                    "plays",
                    time,
                    f"channel {channel} of {self._name} vibrates at {frequency:g} Hz; it was told "
                    f"{drive.frequency:g} Hz",
                )

    def _may_trip(self, time: float) -> bool:
        return self.state == _ENABLED and time > self._fed[0] + self._watchdog - self._slack

    def _check_levels(
        self, levels: Sequence[float], begin: float, end: float, *, of_sensor: bool = False
    ) -> None:
        for channel, level in enumerate(levels):
            fade = self._fades.get(channel, Fade())
            low, high = fade.within(begin - self._slack, end + self._slack)
            is_low = False
            if level > high + _LEVEL:
                wrong = f"at most {high:.4f}"
            elif level < low - _LEVEL and not (self._is_warm or self._may_trip(end)):
                is_low = True
                wrong = f"at least {low:.4f}"
            else:
                continue
            is_settled = begin > fade.settled_from
            found = (
                self._rule_of_level(channel, level, is_settled=is_settled),
                end,
                f"channel {channel} of {self._name} has level {level:.4f}; it must be {wrong}, "
                f"{'' if is_settled else 'fading '}after {self._cause}",
            )
            if is_low and of_sensor and self.is_enabled:
                self._suspicions.append(found)
            else:
                self._complain(*found)

    def _rule_of_level(self, channel: int, level: float, *, is_settled: bool) -> str:
        if self._cause == "the watchdog":
            return "watchdog"
        if not is_settled:
            return "ramp"
        if self._cause != "set":
            return "silent"
        before = self._levels_before.get(channel, 0.0)
        return "commit" if abs(level - before) < _LEVEL else "plays"

    def _named(self) -> str:
        return NAMES[self.state] if self.state is not None else "some state"
