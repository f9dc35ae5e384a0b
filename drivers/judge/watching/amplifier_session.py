"""The host's communication with one amplifier, as far as rules need to remember it.

Deadlines: what must have happened by a time is due later by the delays of the witness itself. Rules
for one set that a host sends: token and limits.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from drivers.judge.watching.capture import ReportViolation
from drivers.judge.watching.config import AmplifierConfig
from drivers.judge.watching.watched_amplifier import WatchedAmplifier
from drivers.playing.playback import Playback
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet, is_newer_token
from era_haptics.lab.expected_output import silent

_TOKENS_KEPT = 16  # of commits


@dataclass
class AmplifierSession:
    """Requests to one amplifier by name, and the model of it; times [s].

    report_always: for violations that no fault of the wire excuses; report: for all others.
    is_disturbed: whether what passed on the wire shortly before a time may have been lost. played:
    what it was sent to play; last_set: sent since Arm, token and layers; staged: the same, unless
    it was silenced since.
    """

    name: str
    config: AmplifierConfig
    amplifier: WatchedAmplifier
    report_always: ReportViolation
    report: ReportViolation
    is_disturbed: Callable[[float], bool]
    played: Playback = field(default_factory=silent)
    last_set: tuple[int, Sequence[LayerSet]] | None = None
    staged: tuple[int, Sequence[LayerSet]] | None = None
    session: int | None = None  # with which the host has armed it
    last_silenced: float = -math.inf  # when a silencing request was sent
    committed_tokens: deque[int] = field(default_factory=lambda: deque(maxlen=_TOKENS_KEPT))
    is_identified: bool | None = None
    is_open: bool = True
    is_stopped: bool = False
    is_requested: bool = False  # whether it is latched, by a host that has opened the wire since
    armed_at: float = -math.inf
    first_stop: float | None = None  # that is not confirmed yet
    is_disarming: bool = False  # until it has shown silence
    last_stop: float = -math.inf  # or status read
    last_feed: float | None = None
    heard_other_host: float = -math.inf
    overdue_at: float = -math.inf  # when a reply was last overdue
    is_mute: bool = False  # it has restarted, and replies to nothing until it is identified
    constants: dict[str, Values] = field(default_factory=dict)

    def vibrates(self, time: float) -> bool:
        """Whether it vibrates at a time by what was sent until now."""
        self.played.advance(time)
        return any(self.played.end_of(layer) > time for layer in self.played.tokens)

    def silence_sent(self, time: float) -> None:
        """Note a request that silences all layers and drops what is staged."""
        self.played = silent()
        self.last_silenced, self.staged = time, None

    def forget_amplifier(self) -> None:
        """Take it for another one from now on, or for one that has started."""
        self.amplifier.forget()
        self.constants.clear()
        self.played = silent()

    def check_constant(self, what: str, reported: Values, time: float) -> None:
        """Compare what must be the same for ever with what was reported before."""
        if reported != self.constants.setdefault(what, reported):
            self.report("constant", time, f"{self.name}: reply to {what} has changed")
        self.constants[what] = reported


_DELAYS_KEPT = 64
_MAX_DEFER = 0.1  # s; before a deadline, within which delays defer it


Expected = tuple[str, AmplifierSession, Callable[[], bool]]
"""A rule, of which amplifier, and whether it is kept at a time."""


class Deadlines:
    """Rules for a host, each to be kept by a time [s]; delays of this program defer it."""

    def __init__(self) -> None:
        self._delays: deque[tuple[float, float]] = deque(maxlen=_DELAYS_KEPT)
        self._pending: list[tuple[float, Expected, str]] = []

    def delayed(self, until: float, duration: float) -> None:
        """Note that nothing was seen for a duration [s] until a time [s]."""
        self._delays.append((until, duration))

    def delay_since(self, time: float) -> float:
        """Sum of the delays [s] that ended after a time [s]."""
        return sum(duration for until, duration in self._delays if until >= time)

    def expect(self, since: float, limit: float, expected: Expected, what: str) -> None:
        """Expect a rule to be kept within a limit [s] of a time; what: to say where it is not."""
        what = f"{what} within {limit * 1e3:g} ms"
        self._pending.append((since + limit, expected, what))

    def advance(self, time: float) -> None:
        """Check the deadlines that have passed, but for those of a disturbed wire."""
        pending, self._pending = self._pending, []
        for due, expected, what in pending:
            rule, session, is_kept = expected
            if due + self.delay_since(due - _MAX_DEFER) >= time:
                self._pending.append((due, expected, what))
            elif not (session.is_disturbed(due) or is_kept()):
                session.report_always(rule, due, what)


_STEP = 0.6  # of a step of the wire; tolerance of rounding
_FRACTIONS = 16  # of a transition at which sums are looked at
_ABOVE = 1.01  # of a sum; what it may exceed a limit by, for moments that are not known
_FREQUENCY, _LEVEL = QUANTITIES["frequency"], QUANTITIES["level"]


def check_set(
    session: AmplifierSession, time: float, token: int, layers: Sequence[LayerSet]
) -> None:
    """Check token and limits of a set that is sent."""
    last = session.last_set or (0, ())
    session.staged = session.last_set = (token, layers)
    is_same = session.staged == last
    if last[0] and not is_same and not is_newer_token(token, last[0]):
        other = " with other contents" if token == last[0] else ""
        session.report_always(
            "token", time, f"set {token} sent to {session.name} after set {last[0]}{other}"
        )
    count = session.amplifier.can.get("layers", math.inf)
    for one in layers:
        if one.layer >= count:
            session.report_always(
                "limits", time, f"set {token}: {session.name} has no layer {one.layer}"
            )
        for command in one.commands:
            if command.is_driven and (problem := _problem_of(session, command)):
                session.report_always(
                    "limits", time, f"channel {command.channel} of {session.name}: {problem}"
                )


def _problem_of(session: AmplifierSession, command: Command) -> str:
    """Describe which limit of its channel a command breaks; "" for none."""
    limits = session.config.channels.get(command.channel)
    if limits is None:
        return "no such channel"
    frequency, (low, high) = _FREQUENCY.from_wire(command.frequency), limits.frequency
    if not low - _FREQUENCY.step * _STEP <= frequency <= high + _FREQUENCY.step * _STEP:
        return f"frequency must be {low:g} to {high:g} Hz, got {frequency:g}"
    shapes = [shape for shape in (command.onset, command.ending) if shape is not None]
    level = max(command.level, *(level for shape in shapes for level, _ in shape.knots), 0)
    if _LEVEL.from_wire(level) > limits.level + _LEVEL.step * _STEP:
        return f"level must be at most {limits.level:g}, got {_LEVEL.from_wire(level):g}"
    return ""


def check_sums(session: AmplifierSession, time: float) -> None:
    """Check what an amplifier plays from a time on, over all layers."""
    sums = _sums(session.amplifier.to_play, time)
    for channel, limits in session.config.channels.items():
        level, rise = sums.get(channel, (0.0, 0.0))
        for what, value, limit in (("level", level, limits.level), ("rise", rise, limits.slew)):
            if value > limit * _ABOVE + _LEVEL.step:
                session.report_always(
                    "limits",
                    time,
                    f"{session.name}: {what} of channel {channel}, sum of all layers, must be at "
                    f"most {limit:g}, got {value:.4g}",
                )


def _sums(playback: Playback, time: float) -> Mapping[int, tuple[float, float]]:
    """Return the largest level and the steepest rise that follow from a time on, by channel.

    In full levels and full levels/s; looked at along the transitions under way.
    """
    times = {time}
    playing = {each: one for each, one in enumerate(playback.all_voices) if one}
    for way in [voice.transition for voices in playing.values() for voice in voices]:
        count = max(_FRACTIONS, len(way.knots) + 1)
        steps = range(count + 1)
        times.update(way.start + (way.end - way.start) * part / count for part in steps)
    moments = sorted({round(at, 6) for at in times if at >= time})  # no sums of floats
    sums: dict[int, tuple[float, float]] = {}
    for channel, voices in playing.items():
        row = [sum(abs(each.transition.at(at)) for each in voices) for at in moments]
        steeps = zip(pairwise(row), pairwise(moments), strict=True)
        sums[channel] = max(row), max(((b - a) / (t - s) for (a, b), (s, t) in steeps), default=0.0)
    return sums
