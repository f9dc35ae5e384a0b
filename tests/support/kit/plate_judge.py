"""Judges what simulated amplifiers really do: their replies, and what they play on the plate.

The amplifiers are followed at their end of the wire by the model that conformance has of one
(`era_haptics.lab.expectations`): state, latch, watchdog, tokens, levels and clock of each
reply must be as expected. Fingers are judged by the touch frames alone and docs/reference/touch.md.
What must hold whatever fails is judged by what really plays, with bounds that the fault table and
the timeouts of a link add up to. Times in s.
"""

import asyncio
import math
from collections.abc import Mapping
from functools import partial

from controller.sources.touch import TouchFrame
from drivers.protocol.definition import MESSAGES, QUANTITIES, STATES
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import is_last
from era_haptics.lab.expectations.expected_amplifier import ExpectedAmplifier
from era_haptics.lab.expectations.tolerances import Interval
from kit.host_rules import HostRules, RuleViolation, tell_first
from kit.wires import FarSide, after_each
from registry.virtual_time import START
from sim.bench.amplifier_device import AmplifierDevice
from sim.faults import FaultWindow

_SLACK = 0.001  # s; of times of amplifiers
_HALF_STEP = 0.026  # Hz; of a frequency on the wire
_LAYERS = QUANTITIES["layer_count"].maximum


class AmplifierRules(ExpectedAmplifier):
    """Judges the replies and Events of one simulated amplifier, at its end of the wire."""

    def __init__(self, device: AmplifierDevice, violations: list[RuleViolation]) -> None:
        super().__init__(self._note, slack=_SLACK)
        self._name = device.name
        self._violations = violations
        self._obey = device.handle
        self._obeys_at = -math.inf  # when the request came that is carried out
        device.handle = self._handle  # type: ignore[method-assign]
        device.listeners.append(self._event_sent)
        tell_first(device, "withdraw_status", lambda: self.clock.unheard())
        tell_first(device, "inject_fault", self._fault_injected)

    def check_frequencies(self, played: Mapping[int, float], now: float) -> None:
        """Compare the frequencies [Hz] of channels that play steadily with the commanded ones."""
        when = Interval(now, now)
        self.advance(now)
        if self.may_start(when) or len(self.outputs.sure(when)) < _LAYERS:
            return
        settled_before = now - self.outputs.uncertain_playback.lag - self.slack
        for channel, frequency in played.items():
            voices = self.outputs.playback.all_voices[channel]
            commanded = [voice.frequency for voice in voices if not voice.has_ended]
            is_settled = all(voice.transition.end < settled_before for voice in voices)
            is_other = all(abs(value - frequency) > _HALF_STEP for value in commanded)
            if commanded and is_settled and is_other:
                quantity = f"frequency of channel {channel}"
                self.report("plays", now, quantity, expected=commanded, actual=frequency)

    def _handle(self, name: str, values: Values, now: float) -> Values:
        """Have a request carried out, and compare the reply."""
        is_part = name == "Set" and not is_last(values)
        if name == "Set" and not is_part:
            self.sets.sent(values)
        self._obeys_at = now
        try:
            reply = self._obey(name, values, now)
        except Refusal as refusal:
            self._refused(name, values, refusal, now)
            raise
        when = Interval(now, now)
        if is_part:
            self.part_came(values, when)
        else:
            self.granted(name, values, reply, when)
        if name == "GetCaps":
            self.identified(reply)
        return reply

    def _refused(self, name: str, values: Values, refusal: Refusal, now: float) -> None:
        if name == "Set":
            self.part_refused(values, refusal.code)
        if name in ("Stop", "Disarm") and refusal.code != "BUSY":
            self.report("stop", now, f"answer to {name}", expected="a status", actual=refusal.code)

    def _event_sent(self, event: Values, at: float) -> None:
        """Compare an Event, unless a request has caused it, whose reply shows the same."""
        if at >= self._obeys_at > at - _SLACK:
            return
        self.advance(at)
        when = Interval(at, at)
        if not self.note_state(event, when):
            self._adopt(event, when)
        self.last_status = at

    def _fault_injected(self, window: FaultWindow) -> None:
        if window.fault == "reboot":
            self.forget("a restart")
        elif window.fault == "over_temperature":
            # The temperature jumps: the amplifier derates before any status shows it.
            self.outputs.may_derate = True

    def _note(
        self, rule: str, time: float, quantity: str, *, expected: object, actual: object
    ) -> None:
        problem = f"amplifier {self._name}: {quantity} must be {expected}, got {actual}"
        self._violations.append(RuleViolation(rule, time, problem))


CONTACT_TIMEOUT = 0.150  # s; a source without news for so long has lost its fingers
_GLIMPSE = 0.005  # s; a finger that is gone sooner may have come and gone between two cycles,
_TAP = 0.060  # s; and then counts for so long, so that a tap is felt


class SourceContacts:
    """The contacts of every source, by source and id; times [s]."""

    def __init__(self) -> None:
        self._now: dict[str, tuple[float, frozenset[tuple[str, int]]]] = {}
        self._until: dict[str, float] = {}  # by source: end of its contacts
        self._since: dict[tuple[str, int], float] = {}
        self._taps: dict[tuple[str, int], float] = {}  # when those end that are lifted already

    def take(self, frame: TouchFrame, now: float) -> None:
        """Take a frame that has been delivered, and replaces what its source has said before."""
        source, stamp = frame.source, frame.time
        last = {touch.id: (touch.x, touch.y) for touch in frame.touches}
        numbers = frozenset(
            (source, number)
            for number, (x, y) in last.items()
            if 0 <= x <= 1 and 0 <= y <= 1  # NaN is not
        )
        ended, were = self._now.get(source, (-math.inf, frozenset[tuple[str, int]]()))
        were = were if now < ended else frozenset()
        for key in were - numbers:
            if stamp - self._since[key] < _GLIMPSE:
                self._taps[key] = self._since[key] + _TAP
        self._since |= dict.fromkeys(numbers - were, stamp)
        lasts = frame.timeout or CONTACT_TIMEOUT
        end = min(stamp, now) + lasts if math.isfinite(stamp) else -math.inf
        self._now[source] = end, numbers
        former_end = min(self._until.get(source, -math.inf), now)
        self._until[source] = max(end if numbers else -math.inf, former_end)

    @property
    def last(self) -> float:
        """When the plate is or was touched last, as far as is known."""
        return max([*self._until.values(), *self._taps.values()], default=-math.inf)

    def at(self, now: float) -> frozenset[tuple[str, int]]:
        """All that are on the plate."""
        taps = {key for key, end in self._taps.items() if now < end}
        return frozenset(taps).union(*(keys for end, keys in self._now.values() if now < end))

    def next_end(self, now: float) -> float:
        """When the first source is overdue if nothing more is heard; infinity if none can be."""
        ends = [end for end, keys in self._now.values() if keys]
        return min((end for end in (*ends, *self._taps.values()) if end > now), default=math.inf)


_ENDED = 1e-6  # s; after contacts have ended
AUDIBLE = 1e-3  # of full stroke; below it a ramp counts as ended
WATCHDOG = 0.25  # s; of armed amplifiers
_SILENCING = 0.005  # s; then every channel is silent
# s; three unanswered requests, then the watchdog, and a heartbeat that was on its way.
RELEASE_WITH_FAULTS = 3 * 0.15 + WATCHDOG + _SILENCING + 0.1
TOGETHER = 0.6  # s; until all are silent after one of them has a fault
STEP = 0.020  # s; check interval while a channel vibrates
IDLE_STEP = 1.0
# Those with a ramp to silence of their own end what the watchdog would.
_SILENCING_REQUESTS = ("Disarm", "Stop")
_FAULTED = (STATES["FAULT"], STATES["FAULT_REACTION_ACTIVE"])


class PlateJudge:
    """Judges what plays at the far ends, and tells the rules for hosts about levels and contacts.

    step [s]: between two looks while a channel vibrates; watchdog [s]: of armed amplifiers; what
    plays without fingers is judged once there has been one. violations: those found, each with its
    time; contacts: all that are on the plate.
    """

    def __init__(
        self,
        far: FarSide,
        host_rules: HostRules,
        *,
        step: float = STEP,
        watchdog: float = WATCHDOG,
    ) -> None:
        self.violations: list[str] = []
        self.contacts = SourceContacts()
        self._bench = far.bench
        self._host_rules = host_rules
        self._step = step
        self._watchdog = watchdog
        self._amplifiers: dict[str, AmplifierRules] = {}
        self._fed = dict.fromkeys(far.devices, -math.inf)
        self._faulted: dict[str, float] = {}
        self._loop = asyncio.get_running_loop()
        self._next = self._loop.call_later(IDLE_STEP, self._watch)
        self._expiry: asyncio.TimerHandle | None = None
        for name, device in far.devices.items():
            self._amplifiers[name] = AmplifierRules(device, host_rules.violations)
            after_each(device, partial(self._exchanged, name))
            device.listeners.append(partial(self._received, name))

    def violate(self, problem: str) -> None:
        """Record a violation."""
        if len(self.violations) < 20:
            self.violations.append(f"{self._loop.time() - START:.6f} {problem}")

    def touched(self, frame: TouchFrame, *, must_be_felt: bool) -> None:
        """Note a frame of a source; must_be_felt: whether new contacts must lead to a pattern."""
        self.contacts.take(frame, self._loop.time())
        self._show_contacts(must_be_felt=must_be_felt)

    def _show_contacts(self, *, must_be_felt: bool = False) -> None:
        now = self._loop.time()
        self._host_rules.set_contacts(self.contacts.at(now), must_be_felt=must_be_felt)
        end = self.contacts.next_end(now) + _ENDED
        if self._expiry is not None:
            self._expiry.cancel()
            self._expiry = None
        if end < math.inf:
            self._expiry = self._loop.call_at(end, self._show_contacts)

    def check(self) -> None:
        """Advance the bench to now, and check it."""
        now = self._loop.time()
        self._bench.advance(now)
        for name, amplifier in self._bench.amplifiers.items():
            playback = amplifier.playback
            levels = [
                min(playback.level(channel, now), 1.0) for channel in range(playback.channels)
            ]
            if not max(levels) <= AUDIBLE:
                self._check_loud(name, max(levels), now)
            self._host_rules.check_level(name, levels)
            frequencies = {
                channel: tone.frequency
                for channel, output in enumerate(amplifier.outputs)
                for tone in output
                if tone.transition.last
            }
            self._amplifiers[name].check_frequencies(frequencies, now)

    def loudest(self, name: str, within: float, looks: int) -> float:
        """Highest level that an amplifier plays within a time [s] without a request, in looks."""
        now, playback = self._loop.time(), self._bench.amplifiers[name].playback
        self._bench.advance(now)
        return max(
            playback.level(channel, now + within * number / looks)
            for number in range(looks)
            for channel in range(playback.channels)
        )

    def close(self) -> None:
        """Stop checking."""
        self._next.cancel()
        if self._expiry is not None:
            self._expiry.cancel()

    def _exchanged(self, name: str, request: str, *_: object) -> None:
        """Note that an amplifier has carried out a request."""
        now = self._loop.time()
        if request == "Arm":
            self._faulted.pop(name, None)
        if MESSAGES[request].feeds or request in _SILENCING_REQUESTS:
            self._fed[name] = now
        if self._due() < self._next.when():
            self._watch()

    def _watch(self) -> None:
        """Check periodically, more often while a channel vibrates."""
        self._next.cancel()
        self.check()
        self._next = self._loop.call_at(self._due(), self._watch)

    def _due(self) -> float:
        """When to check next: the amplifiers have nothing to wake them but this."""
        now, amplifiers = self._loop.time(), self._bench.amplifiers.values()
        plays = any(
            tone.silent_from > now
            for amplifier in amplifiers
            for output in amplifier.outputs
            for tone in output
        )
        step = self._step if plays else IDLE_STEP
        return min(now + step, *(amplifier.next_event for amplifier in amplifiers))

    def _received(self, name: str, event: Values, at: float) -> None:
        if event["state"] in _FAULTED:
            self._faulted.setdefault(name, at)
        else:
            self._faulted.pop(name, None)

    def _check_loud(self, name: str, level: float, now: float) -> None:
        bounds = {"its last feeding": (self._fed[name], self._watchdog + _SILENCING)}
        if self.contacts.last > -math.inf:
            bounds["the last finger"] = (self.contacts.last, RELEASE_WITH_FAULTS)
        for faulted in self._faulted.keys() - {name}:
            bounds[f"the fault of {faulted}"] = (self._faulted[faulted], TOGETHER)
        for reason, (since, bound) in bounds.items():
            if now - since > bound:
                self.violate(f"{name} plays at {level:.4f} {now - since:.4f} s after {reason}")
