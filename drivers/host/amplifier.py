"""One amplifier of protocol 4 on any wire: the exchanges with it.

`Amplifier` identifies, arms, plays, silences, disarms and stops one amplifier. What its requests
and replies show is noted by `AmplifierRecord`.
"""

import asyncio
import contextlib
import math
from collections.abc import Callable, Coroutine
from functools import partial
from typing import Any

from drivers.errors import CommandError, CommandRefused, FrameError, LinkTimeout, Preempted
from drivers.host.amplifier_record import AmplifierRecord, disarmed
from drivers.host.identification import driven_by_another
from drivers.host.requests import Priority
from drivers.host.set_admission import IsPreempted, StagedSet
from drivers.host.statuses import MAX_CONTRADICTIONS, contradicted
from drivers.host.stops import CONFIRM_INTERVAL, PendingStop, StopOutcome
from drivers.protocol.achieved import achieved_layer, achieved_problem
from drivers.protocol.definition import (
    ATTEMPTS,
    ENABLED,
    QUANTITIES,
    REPLY_TIMEOUT,
    STATES,
    STOP_RAMP,
)
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, is_newer_token
from registry import threads

WATCHDOG = 0.25  # s; five heartbeats of 50 ms
DISARM_RAMP = 0.05  # s; long enough to avoid a click
OPEN_TIMEOUT = 0.5  # s; for each reply while an amplifier is opened, also on a busy machine
_ARM_WITHIN = 3.0  # s; an Arm sent later than this after its request is too late
CONFIRM_TIMEOUT = 0.3  # s; three replies of the slowest wire
LISTENING = 0.3  # s; how long the host listens for another one if it finds an armed amplifier
SECOND_REPLY = 0.02  # s; how long it waits for a second amplifier at the same address
_RAMP = QUANTITIES["ramp"]
_WATCHDOG = QUANTITIES["watchdog"]
_ENERGISED = (STATES["SWITCHED_ON"], ENABLED)
_WIRE_ROUNDING = 0.5  # steps of the wire, in addition to half a step of the amplifier


class Amplifier(AmplifierRecord):
    """An amplifier on an open line, and the exchanges with it."""

    _stop: PendingStop | None = None
    """The last stop, which later callers join until it was sent."""

    async def stage(
        self,
        staged: StagedSet,
        token: int,
        *,
        now: bool = False,
        priority: Priority = Priority.SET,
        is_preempted: IsPreempted | None = None,
    ) -> StagedSet:
        """Stage a set under a token, or play it immediately if `now`; return it.

        The ledger admits it when its turn on the line comes, unless it is preempted then. Raises
        CommandRefused with the reason; Preempted if a stop came first; FrameError if two replies in
        a row have another token.
        """
        staged.token = token
        staged.is_immediate = now
        staged.starts_at = None
        make = partial(self._make_set, staged, is_preempted)
        for _ in range(MAX_CONTRADICTIONS):
            reply = await self.line.submit(self, priority, "Set", make)
            if reply["token"] == token:
                break
        else:
            problem = f"a set with token {token} must be taken, got token {reply['token']}"
            # This is not a rejection: the group stops all amplifiers.
            raise FrameError(str(contradicted(self.name, problem)))
        is_staged = reply["staged"] and not now and self.admission.admitted is staged
        if not (reply["played"] or is_staged):
            raise Preempted(f"amplifier {self.name}: set {token} was not staged")
        staged.is_exact = bool(reply["exact"])
        return staged

    def _make_set(self, staged: StagedSet, is_preempted: IsPreempted | None) -> list[Values]:
        """Admit a set, and return the values of its parts; raises CommandRefused or Overtaken."""
        return self.admission.admit(
            staged,
            self.ledger,
            self._time(),
            session=self.session,
            set_time=self._sets_time(),
            is_preempted=is_preempted,
        )

    def refusal_of(self, staged: StagedSet) -> CommandRefused | None:
        """Return why the ledger would not admit a set now; None if it would."""
        return self.admission.refusal_of(
            staged, self.ledger, self._time(), set_time=self._sets_time()
        )

    def _sets_time(self) -> float:
        """Return how long sets to all amplifiers of the line take [s]."""
        return len(self.line.members) * self.exchange_time("Set")

    def commit(self, staged: StagedSet, at: int) -> asyncio.Future[Values]:
        """Play a staged set; returns a future of the status, which shows the tokens.

        at: high word of the amplifier's clock at which it starts. The future raises Preempted if a
        stop or disarm came first, CommandRefused if it is too late for the ledger's admission.
        """
        values = {"session": self.session, "token": staged.token, "at": at}
        return self.line.submit(self, Priority.SET, "Commit", values)

    def wire_ramp(self, ramp: float) -> int:
        """Return the nearest ramp [s] that the amplifier can play, in units of the wire.

        Any number is accepted, since silence must never be refused for its ramp.
        """
        if math.isnan(ramp):
            return _RAMP.to_wire(STOP_RAMP)
        wire_ramp = _RAMP.to_wire(min(max(ramp, 0.0), _RAMP.high))
        if not self.identification.is_complete:
            return wire_ramp
        ramp_max: int = self.capabilities["ramp_max"]
        return min(wire_ramp, ramp_max)

    async def open(self) -> None:
        """Identify the amplifier and leave it disarmed; a latched stop or fault stays latched.

        Raises LinkError if it is another amplifier, speaks another version, or is driven by another
        host.
        """
        status = await self.identify()
        if status["state"] == ENABLED:
            await self._listen_for_another_host(status)
            await self.disarm(STOP_RAMP)

    async def identify(self, *, timeout: float = OPEN_TIMEOUT) -> Values:
        """Read identity and capabilities, and return the status; raises LinkError.

        timeout: for each reply [s]. The newest latch is then the one in this status, because the
        amplifier may have lost power before.
        """
        identification = self.identification
        identification.expect_one()
        try:
            identity = await self.request("Hello", {}, Priority.OTHER, timeout=timeout)
            await asyncio.sleep(SECOND_REPLY)
        except LinkTimeout:
            identification.check_alone()
            raise
        identification.check_alone()
        identification.check_identity(identity)
        capabilities = await self.request("GetCaps", {}, Priority.OTHER, timeout=timeout)
        identification.check_capabilities(capabilities)
        self.note_identified(identity, capabilities)
        return await self.read_status()

    def arm(self, session: int, watchdog: float = WATCHDOG) -> Coroutine[Any, Any, Values]:
        """Switch the high voltage on at level zero, and return the status; watchdog [s].

        Identifies the amplifier again, because it may have lost power and returned with other
        limits. A stop or disarm that comes after this call goes first, even before it is awaited.
        """
        check = partial(self._check_may_arm, self.disarms_sent, threads.now() + _ARM_WITHIN)
        return self._arm(session, watchdog, check)

    def _check_may_arm(self, disarms_sent: int, until: float) -> None:
        """Raise Preempted or LinkTimeout if an Arm must not be sent any more.

        disarms_sent: when the Arm was requested; until: when it expires [s].
        """
        if self.disarms_sent != disarms_sent:
            raise Preempted(f"amplifier {self.name}: a stop or disarm came first")
        if self._time() > until:  # this machine slept, and the caller does not expect it now
            raise LinkTimeout(f"amplifier {self.name}: identified too late; arm again")

    async def _arm(self, session: int, watchdog: float, check: Callable[[], None]) -> Values:
        """Arm the amplifier; check: called before Arm is sent, see `Line.submit`."""
        # The timeout is short so that the watchdogs of other armed amplifiers do not run down.
        await self.identify(timeout=REPLY_TIMEOUT)
        wire = _WATCHDOG.to_wire(watchdog)
        low = self.ledger.capabilities["watchdog_min"]
        high = self.ledger.capabilities["watchdog_max"]
        if not low <= wire <= high:
            bounds = f"{_WATCHDOG.from_wire(low):g} to {_WATCHDOG.from_wire(high):g}"
            raise CommandError(f"watchdog must be {bounds} s, got {watchdog:g} s")
        self.feeding.watchdog = max(self.feeding.watchdog, watchdog)

        def make() -> list[Values]:
            shift = self.clock.shift(self._time())
            return [{"session": session, "watchdog": wire, "shift": shift}]

        was_armed = self.may_be_armed
        try:
            status = await self.line.submit(self, Priority.ARM, "Arm", make, check=check)
        except CommandRefused as error:
            if not (isinstance(error, Preempted) or error.may_play):
                self.may_be_armed = was_armed
            raise
        self.note_armed(session, watchdog, status)
        if status["state"] != ENABLED:
            raise disarmed(self.name, status)
        return status

    async def read_achieved(self, layer: LayerSet, token: int) -> LayerSet:
        """Read how the amplifier plays a layer of the set with this token.

        The ledger uses the result from then on. A layer that continues an earlier set is returned
        as it was sent. Raises CommandRefused if the amplifier contradicts two sets in a row.
        """
        reply = await self.request("GetAchieved", {"layer": layer.layer}, Priority.SET)
        if layer.renew or reply["token"] != token:
            return layer
        capabilities = self.ledger.capabilities
        problem = achieved_problem(layer, reply, capabilities, is_exact=False, slack=_WIRE_ROUNDING)
        achieved = achieved_layer(layer, reply, capabilities)
        if problem is None:
            self.contradictions.note_achieved(None)
            self.ledger.correct(layer, achieved, token)
            return achieved
        self.contradictions.note_achieved(
            f"{problem.quantity} in layer {layer.layer} must be {problem.required}, got "
            f"{problem.received}"
        )
        return achieved

    async def silence(self, ramp: float) -> Values:
        """Let all layers fall silent along a ramp [s]; the amplifier stays armed."""
        return await self.request(
            "Silence",
            {"session": self.session, "ramp": self.wire_ramp(ramp)},
            Priority.SILENCE,
        )

    async def disarm(self, ramp: float = DISARM_RAMP) -> None:
        """Ramp to silence [s] and switch the high voltage off; read back until it is silent.

        Raises CommandRefused if the amplifier is not silent soon after the ramp, or is still armed.
        """
        wire_ramp = self.wire_ramp(ramp)
        status = await self.request("Disarm", {"ramp": wire_ramp}, Priority.SILENCE)
        end = threads.now() + _RAMP.from_wire(wire_ramp) + CONFIRM_TIMEOUT
        while status["state"] in _ENERGISED or not self.is_silent(status):
            if threads.now() > end or status["state"] == ENABLED:
                raise CommandRefused(f"amplifier {self.name} is not silent after a disarm")
            await asyncio.sleep(CONFIRM_INTERVAL)
            status = await self.read_status(Priority.SILENCE)
        self.may_be_armed = False

    def ping(self) -> "asyncio.Future[Values]":
        """Feed the watchdog and steer the clock; returns a future of the status.

        The future raises CommandRefused if the amplifier is not armed.
        """

        def make() -> list[Values]:
            rate = self.clock.rate(self._time(), is_playing=self.is_playing)
            return [{"session": self.session, "rate": rate}]

        return self.line.submit(self, Priority.HEARTBEAT, "Ping", make)

    def read_status(self, priority: Priority = Priority.OTHER) -> "asyncio.Future[Values]":
        """Read the status; this does not feed the watchdog."""
        return self.line.submit(self, priority, "GetStatus", {})

    async def clear(self) -> Values:
        """Acknowledge the newest stop or fault that the amplifier has shown.

        Identifies the amplifier again: after a loss of power it counts latches from 1.
        """
        last_disarms_sent = self.disarms_sent
        last_latch = self.latch
        status = await self.identify(timeout=REPLY_TIMEOUT)
        has_restarted = last_latch is None or is_newer_token(last_latch, status["latch"])
        latch = status["latch"] if has_restarted else last_latch
        if self.disarms_sent != last_disarms_sent:
            raise Preempted(f"amplifier {self.name}: a stop or disarm came first")
        self.playback_bound.note_cleared()
        return await self.request("Clear", {"latch": latch}, Priority.CLEAR)

    def stop(
        self, ramp: float = STOP_RAMP, *, timeout: float = CONFIRM_TIMEOUT
    ) -> "asyncio.Future[StopOutcome]":
        """Stop along a ramp [s] and latch; the request is queued when this returns.

        The future ends once silence is confirmed, or when a timeout [s] has passed after the
        request went out. Calls before that join the same stop, which goes on if a caller is
        cancelled.
        """
        stop = self._stop
        if stop is None or stop.is_sent or stop.outcome.done():
            members = len(self.line.members)
            wire_ramp = self.wire_ramp(ramp)
            # On a shared line each amplifier has three exchanges: a stop and two statuses.
            timeout += ATTEMPTS * members * self.exchange_time("GetStatus")
            timeout += _RAMP.from_wire(wire_ramp)
            ends_at = threads.now() + timeout * (members + 1)  # others may keep the line busy
            stop = PendingStop(self, wire_ramp, timeout, ends_at)
            self._stop = stop
            stop.outcome = asyncio.ensure_future(self._outcome_of(stop))
            with contextlib.suppress(Exception):  # then `PendingStop.repeat` makes the request
                stop.queue()
        return asyncio.shield(stop.outcome)

    async def _outcome_of(self, stop: PendingStop) -> StopOutcome:
        """Repeat a stop until it is confirmed or has failed, and return its outcome."""
        cause = await stop.repeat()
        if stop.is_confirmed:
            self.playback_bound.note_stopped(threads.now())
        return self.what_may_play(cause, stop)

    async def request(
        self,
        name: str,
        values: Values,
        priority: Priority = Priority.OTHER,
        *,
        timeout: float = REPLY_TIMEOUT,
    ) -> Values:
        """Send a request that the ledger need not admit; returns the values of its reply."""
        return await self.line.submit(self, priority, name, values, timeout=timeout)

    async def _listen_for_another_host(self, status: Values) -> None:
        """Raise LinkError if another host feeds its watchdog while this one listens."""
        end = threads.now() + LISTENING
        left = status["watchdog_left"]
        while threads.now() < end and status["state"] == ENABLED:
            await asyncio.sleep(LISTENING / 10)
            status = await self.read_status()
            self.check_other_host()
            if status["watchdog_left"] > left:
                raise driven_by_another(self.name)
            left = status["watchdog_left"]
