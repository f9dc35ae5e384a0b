"""Invariants of every soak run, checked on the simulated amplifiers and the touches alone.

Bounds with faults are what the fault table and the timeouts of a link add up to; without faults
they are the table's own.
"""

import asyncio
import math
from collections import deque
from collections.abc import Callable, Mapping

from drivers.protocol.records import Values
from drivers.protocol.table import MESSAGES, STATES
from sim.amplifier.contract import Amplifier
from sim.bench.bench import Bench
from soak_contacts import SourceContacts
from soak_plan import Plan

AUDIBLE = 1e-3  # of full stroke; below it a ramp counts as ended
WATCHDOG = 0.25 + 0.005  # s; then every channel is silent
RELEASE = 0.020  # s; from the last finger up to zero
# s; three unanswered requests, then the watchdog, and a heartbeat that was on its way.
RELEASE_WITH_FAULTS = 3 * 0.15 + WATCHDOG + 0.1
TOGETHER = 0.6  # s; until all are silent after one of them has a fault
_REMEMBERED = 16  # tokens since Arm
STEP = 0.020  # s; check interval while a channel vibrates
IDLE_STEP = 1.0
# Those with a ramp to silence of their own end what the watchdog would.
_SILENCING_REQUESTS = ("Disarm", "Stop")
_FAULTED = (STATES["FAULT"], STATES["FAULT_REACTION_ACTIVE"])
_PLAYING = ("OPERATION_ENABLED", "FAULT_REACTION_ACTIVE", "QUICK_STOP_ACTIVE", "SWITCHED_ON")


Sense = Callable[[str, Amplifier], None]


class Checks:
    """Checks of a bench; `violations`: those found, each with its time.

    release [s]: from the last finger up to silence on the plate, without faults; begin [s]: when
    the plan's time began; arming: whether an arm request is in progress.
    """

    def __init__(
        self,
        bench: Bench,
        plan: Plan,
        *,
        begin: float,
        release: float,
        contacts: SourceContacts,
        arming: Callable[[], bool],
    ) -> None:
        self.violations: list[str] = []
        self._bench = bench
        self._plan = plan
        self._begin = begin
        self._release = release
        self._contacts = contacts
        self._arming = arming
        self._fed = dict.fromkeys(bench.amplifiers, -math.inf)
        self.sense: Sense = lambda name, amplifier: None
        """Called with every amplifier at each check."""
        self._starving: dict[str, asyncio.TimerHandle] = {}
        self._releasing: asyncio.TimerHandle | None = None
        self._is_closed = False
        self._tokens: dict[str, deque[int]] = {
            name: deque(maxlen=_REMEMBERED) for name in bench.amplifiers
        }
        self._token = dict.fromkeys(bench.amplifiers, 0)
        self._faulted: dict[str, float] = {}
        self._loop = asyncio.get_running_loop()
        self._next = self._loop.call_later(IDLE_STEP, self._watch)
        for name, amplifier in bench.amplifiers.items():
            amplifier.listeners.append(lambda event, at, name=name: self._received(name, event, at))

    def violate(self, what: str) -> None:
        """Record a violation."""
        if len(self.violations) < 20:
            self.violations.append(f"{self._loop.time() - self._begin:.6f} {what}")

    def check(self) -> None:
        """Advance the bench to now, and check it."""
        now = self._loop.time()
        self._bench.advance(now)
        loud = {}
        for name, amplifier in self._bench.amplifiers.items():
            playback = amplifier.playback
            level = max(min(playback.level(each, now), 1.0) for each in range(playback.channels))
            if not level <= AUDIBLE:
                loud[name] = level
                self._check_loud(name, level, now)
            self.sense(name, amplifier)
        if loud:
            self._check_touched(loud, now)

    def lifted(self) -> None:
        """After the last lift, or the end of its lease: check when silence is due."""
        if self._releasing is not None:
            self._releasing.cancel()
        due = max(self._contacts.last, self._loop.time()) + self._release + 1e-6
        self._releasing = self._loop.call_at(due, self.check)

    def exchanged(self, name: str, request: str) -> None:
        """Check after an amplifier has carried out a request."""
        now = self._loop.time()
        amplifier = self._bench.amplifiers[name]
        if request == "Arm":
            self._tokens[name].clear()
            self._token[name] = 0
            self._faulted.pop(name, None)
            if not self._arming() and self._plan.is_calm(now - self._begin - 1, now - self._begin):
                self.violate(f"{name} was armed without a request")
        token = amplifier.summary(max(now, self._bench.time)).token
        if token != self._token[name]:
            self._token[name] = token
            if token in self._tokens[name]:
                self.violate(f"{name} has played token {token} twice")
            self._tokens[name].append(token)
        self._check_limits(name)
        if MESSAGES[request].feeds or request in _SILENCING_REQUESTS:
            self._fed[name] = now
            if name not in self._starving:
                self._expect_silence(name)
        if self._plays() and self._next.when() > now + STEP:
            self._watch()

    def close(self) -> None:
        """Stop checking."""
        self._is_closed = True
        self._next.cancel()
        for timer in self._starving.values():
            timer.cancel()

    def _watch(self) -> None:
        """Check periodically, more often while a channel vibrates."""
        self._next.cancel()
        self.check()
        self._next = self._loop.call_later(STEP if self._plays() else IDLE_STEP, self._watch)

    def _plays(self) -> bool:
        now = self._loop.time()
        return any(
            tone.silent_from > now
            for amplifier in self._bench.amplifiers.values()
            for output in amplifier.outputs
            for tone in output
        )

    def _expect_silence(self, name: str) -> None:
        """Check when the watchdog of an amplifier must have silenced it."""
        due = self._fed[name] + WATCHDOG + 1e-6
        if self._loop.time() >= due:
            self._starving.pop(name, None)
            self.check()
        elif not self._is_closed:
            self._starving[name] = self._loop.call_at(due, self._expect_silence, name)

    def _received(self, name: str, event: Values, at: float) -> None:
        if event["state"] in _FAULTED:
            self._faulted.setdefault(name, at)
        else:
            self._faulted.pop(name, None)

    def _check_limits(self, name: str) -> None:
        limits = self._bench.rig.limits
        amplifier = self._bench.amplifiers[name]
        for output in amplifier.outputs:
            if len(output) > amplifier.capabilities["voices"]:
                self.violate(f"{name} plays {len(output)} voices on a channel")
            for tone in output:
                if not limits.frequency_min <= tone.frequency <= limits.frequency_max:
                    self.violate(f"{name} plays {tone.frequency} Hz")

    def _check_loud(self, name: str, level: float, now: float) -> None:
        amplifier = self._bench.amplifiers[name]
        if not level <= self._bench.rig.limits.level + AUDIBLE:
            self.violate(f"{name} plays at a level of {level:.4f}")
        if amplifier.state not in _PLAYING:
            self.violate(f"{name} plays at {level:.4f} in {amplifier.state}")
        if now - self._fed[name] > WATCHDOG:
            self.violate(f"{name} plays {now - self._fed[name]:.4f} s after it was fed")
        for other, at in self._faulted.items():
            if other != name and now - at > TOGETHER:
                self.violate(f"{name} plays {now - at:.4f} s after the fault of {other}")

    def _check_touched(self, loud: Mapping[str, float], now: float) -> None:
        since = now - self._contacts.last
        lifted, at = self._contacts.last - self._begin, now - self._begin
        bound = self._release if self._plan.is_calm(lifted, at) else RELEASE_WITH_FAULTS
        if since > bound:
            self.violate(f"{', '.join(loud)} play {since:.4f} s after the last finger")
