"""One amplifier of protocol 4 on any wire: its identity, its requests and its measurements.

`Amplifier` identifies, arms, silences, disarms and stops it. Measurements, of its channels and of
tones at its sensors, need no session, do not feed the watchdog and do not change what plays.
"""

import asyncio
import contextlib
import random
from collections.abc import Coroutine, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

from drivers.errors import (
    CommandError,
    CommandRefused,
    FrameError,
    LinkTimeout,
    Preempted,
    WrongAmplifier,
)
from drivers.host.dialogue import MAX_CONTRADICTIONS, Dialogue, StopOutcome
from drivers.host.ledger import Ledger
from drivers.host.line import (
    Line,
    LinkStatistics,
    Priority,
    contradicted,
    disarmed,
    driven_by_another,
)
from drivers.protocol.definition import (
    ATTEMPTS,
    ENABLED,
    LATCHED,
    NO_CHANNEL,
    QUANTITIES,
    READING_STATES,
    REPLY_TIMEOUT,
    SENSOR_UNITS,
    STATES,
    STOP_RAMP,
    UNKNOWN_PLACE,
    VERSION,
    capability_ranges,
    has_feature,
    name_of,
    sensor_reading,
)
from drivers.protocol.records import Record, Refusal, Rows, Values, bits_of
from drivers.protocol.sets import LayerSet, achieved_layer, achieved_problem, is_newer_token
from drivers.wires.wire import reply_words
from registry import threads
from registry.limits import GuardLimits

WATCHDOG = 0.25  # s; five heartbeats of 50 ms
DISARM_RAMP = 0.05  # s; long enough to avoid a click
OPEN_TIMEOUT = 0.5  # s; of each request while it is opened, on a busy machine and in a far network
_ARM_WITHIN = 3.0  # s; from the request to arm until it is sent, on the slowest wire
CONFIRM_TIMEOUT = 0.3  # s; three replies of the slowest wire
LISTENING = 0.3  # s; to an amplifier that is found armed
SECOND_REPLY = 0.02  # s; for one of another amplifier at the same address
_INTERVAL = 0.005  # s; between attempts to stop, in addition to the ramp
_RAMP, _WATCHDOG = QUANTITIES["ramp"], QUANTITIES["watchdog"]
_ENERGISED = (STATES["SWITCHED_ON"], ENABLED)
_FULL_LEVEL = ("motion of a stiff source", "output of a linear amplifier")
_WIRE_ROUNDING = 0.5  # steps of the wire, beside half a step of the amplifier


@dataclass(eq=False, slots=True)
class _Stop:
    """A stop along a ramp of the wire, repeated until it is confirmed, or for a time [s].

    ends: end [s] of that time, which starts when the first request goes out; is_sent: whether the
    first request went out, so that whatever is played later needs a stop of its own; requested: the
    first request, queued when the stop was asked for; latch: the newest latch at the last request.
    """

    ramp: int
    timeout: float
    ends: float
    is_sent: bool = False
    limit: asyncio.Timeout | None = None
    requested: "asyncio.Future[Values] | None" = None
    latch: int | None = None
    result: "asyncio.Future[StopOutcome]" = field(init=False)

    def sent(self) -> list[Values]:
        """Return the values of the request, which goes out now."""
        if not self.is_sent:
            self.is_sent = True
            self.ends = threads.now() + self.timeout
            if self.limit is not None:
                self.limit.reschedule(self.ends)
        return [{"ramp": self.ramp}]


class Amplifier(Dialogue):
    """An amplifier on a line that is open.

    limits: configured. serial_number: the expected one, None for any. is_output: what the rig says
    of full level: the output of a linear amplifier, else the motion of a stiff source; None for
    either.
    """

    def __init__(
        self,
        line: Line,
        address: int,
        limits: GuardLimits,
        *,
        name: str,
        serial_number: str | None = None,
        is_output: bool | None = False,
    ) -> None:
        super().__init__(line, address, name)
        self.limits, self._serial_number = limits, serial_number
        self._is_output = is_output
        self.identity: Values = {}
        self._stop: _Stop | None = None

    def go_on_from(self, before: "Amplifier") -> None:
        """Know what was known of it when its line was opened before, and may have been lost."""
        self.known = replace(before.what_may_play(), is_confirmed=before.known.is_confirmed)
        self.may_be_armed = before.may_be_armed

    async def open(self) -> None:
        """Identify it and leave it disarmed; a latched stop or fault stays.

        Raises LinkError for another amplifier or version, or another host that drives it.
        """
        status = await self.identify()
        if status["state"] == ENABLED:
            await self._listen_for_another_host(status)
            await self.disarm(STOP_RAMP)

    async def identify(self, *, timeout: float = OPEN_TIMEOUT) -> Values:
        """Read identity and capabilities, and return the status; raises LinkError.

        timeout [s]: of a reply. Its latch is that of the status from now on: it may have lost its
        supply meanwhile.
        """
        self._are_several = False
        try:
            identity = await self.request("Hello", {}, Priority.OTHER, timeout=timeout)
            await asyncio.sleep(SECOND_REPLY)
        except LinkTimeout:
            self._check_alone()
            raise
        self._check_alone()
        shown, self.capabilities = self.capabilities, {}  # another one's silence confirms nothing
        check_identity(identity, self.name, self._serial_number)
        self.capabilities = shown
        can = await self.request("GetCaps", {}, Priority.OTHER, timeout=timeout)
        check_capabilities(can, self.name, is_output=self._is_output)
        if self._ledger is None:
            self._ledger = Ledger(self.limits, can)
        elif can != self.capabilities:
            self._ledger.adopt(can)
        self.identity, self.capabilities = identity, can
        self.exchange_time.cache_clear()
        status_words = reply_words("GetStatus", can["channels"], can["layers"])
        self.clock.identified(can["clock_error"], bits=self.line.wire.transit(status_words))
        self._serial_number = identity["serial_number"]
        self.latch = None
        return await self.read_status()

    def _check_alone(self) -> None:
        """Raise LinkError where several replied; the silence of one confirms nothing."""
        if self._are_several:
            self.capabilities = {}
            raise WrongAmplifier(
                f"amplifier {self.name}: several amplifiers reply at address {self.address} on "
                f"{self.line.name}; give each its own: era amp address --serial-number"
            )

    def arm(self, session: int, watchdog: float = WATCHDOG) -> Coroutine[Any, Any, Values]:
        """Switch the high voltage on at level zero; watchdog [s]. Returns the status.

        It is identified anew: it may have lost its supply, and come back with other limits. What
        silences it from this call on comes first, also before this is awaited.
        """
        self.arming = self.silences, threads.now() + _ARM_WITHIN
        return self._arm(session, watchdog)

    async def _arm(self, session: int, watchdog: float) -> Values:
        await self.identify(timeout=REPLY_TIMEOUT)  # before the watchdogs of others that are armed
        wire = _WATCHDOG.to_wire(watchdog)
        low, high = (self.ledger.capabilities[f"watchdog_{end}"] for end in ("min", "max"))
        if not low <= wire <= high:
            bounds = f"{_WATCHDOG.from_wire(low):g} to {_WATCHDOG.from_wire(high):g}"
            raise CommandError(f"watchdog must be {bounds} s, got {watchdog:g} s")
        self.feeding.watchdog = max(self.feeding.watchdog, watchdog)

        def make() -> list[Values]:
            shift = self.clock.shift(self._time())
            return [{"session": session, "watchdog": wire, "shift": shift}]

        was_armed = self.may_be_armed
        try:
            status = await self.line.submit(self, Priority.ARM, "Arm", make)
        except CommandRefused as error:
            if not (isinstance(error, Preempted) or error.may_play):
                self.may_be_armed = was_armed
            raise
        self.session, self.feeding.watchdog = session, watchdog
        self.armed_latch = status["latch"]
        self._contradictions = self._misachieved = 0
        self.ledger.forget()
        if status["state"] != ENABLED:
            raise disarmed(self.name, status)
        return status

    async def read_achieved(self, one: LayerSet, token: int) -> LayerSet:
        """Read what plays of a layer of the set with this token; the ledger goes on with it.

        A layer that goes on with an earlier set is returned as it was sent. Raises CommandRefused
        where the amplifier contradicts the set, as it did the last one.
        """
        shown = await self.request("GetAchieved", {"layer": one.layer}, Priority.SET)
        if one.renew or shown["token"] != token:
            return one
        can = self.ledger.capabilities
        problem = achieved_problem(one, shown, can, is_exact=False, slack=_WIRE_ROUNDING)
        achieved = achieved_layer(one, shown, can)
        if problem is None:
            self._misachieved = 0
            self.ledger.correct(one, achieved, token)
            return achieved
        self._misachieved += 1
        if self._misachieved >= MAX_CONTRADICTIONS:
            _, what, must, seen = problem
            raise contradicted(self.name, f"{what} in layer {one.layer} must be {must}, got {seen}")
        return achieved

    async def silence(self, ramp: float) -> Values:
        """Let all layers fall silent along a ramp [s]; it stays armed."""
        return await self.request(
            "Silence",
            {"session": self.session, "ramp": self.wire_ramp(ramp)},
            Priority.SILENCE,
        )

    async def disarm(self, ramp: float = DISARM_RAMP) -> None:
        """Ramp [s] to silence, then switch the high voltage off; read back until it is silent.

        Raises CommandRefused if it is not silent soon after the ramp, or still armed.
        """
        status = await self.request("Disarm", {"ramp": self.wire_ramp(ramp)}, Priority.SILENCE)
        end = threads.now() + ramp + CONFIRM_TIMEOUT
        while status["state"] in _ENERGISED or not self.is_silent(status):
            if threads.now() > end or status["state"] == ENABLED:
                raise CommandRefused(f"amplifier {self.name} is not silent after a disarm")
            await asyncio.sleep(_INTERVAL)
            status = await self.read_status(Priority.SILENCE)
        self.may_be_armed = False

    def ping(self) -> "asyncio.Future[Values]":
        """Feed the watchdog and steer the clock; the future has the status.

        Or CommandRefused if it is not armed.
        """

        def make() -> list[Values]:
            is_playing = self._ledger is not None and any(self._ledger.playback.all_voices)
            rate = self.clock.rate(self._time(), is_playing=is_playing)
            return [{"session": self.session, "rate": rate}]

        return self.line.submit(self, Priority.HEARTBEAT, "Ping", make)

    def read_status(self, priority: Priority = Priority.OTHER) -> "asyncio.Future[Values]":
        """Read the status, which feeds nothing."""
        return self.line.submit(self, priority, "GetStatus", {})

    async def clear(self) -> Values:
        """Acknowledge the newest stop or fault that was shown.

        It is identified anew: one that has lost its supply since counts its latches from 1 again.
        """
        before, shown = self.silences, self.latch
        status = await self.identify(timeout=REPLY_TIMEOUT)
        has_restarted = shown is None or is_newer_token(shown, status["latch"])
        latch = status["latch"] if has_restarted else shown
        if before != self.silences:
            raise Preempted(f"amplifier {self.name}: a stop or disarm came first")
        self.known = replace(self.known, is_confirmed=False)
        return await self.request("Clear", {"latch": latch}, Priority.CLEAR)

    def stop(
        self, ramp: float = STOP_RAMP, *, timeout: float = CONFIRM_TIMEOUT
    ) -> "asyncio.Future[StopOutcome]":
        """Stop along a ramp [s], latched; its request is queued when this returns.

        The future ends once silence is confirmed, or a time [s] after the request has gone out.
        Until then all stops are one, which goes on if the caller is cancelled.
        """
        stop = self._stop
        if stop is None or stop.is_sent or stop.result.done():
            members, wire_ramp = len(self.line.members), self.wire_ramp(ramp)
            # On a line that others share each has three exchanges: a stop and two statuses.
            timeout += ATTEMPTS * members * self.exchange_time("GetStatus")
            timeout += _RAMP.from_wire(wire_ramp)
            ends = threads.now() + timeout * (members + 1)  # on a line that others keep busy
            self._stop = stop = _Stop(wire_ramp, timeout, ends)
            stop.result = asyncio.ensure_future(self._confirm_stop(stop))
            with contextlib.suppress(Exception):  # then it is requested in `_confirm_stop`
                stop.requested = self._request_stop(stop)
        return asyncio.shield(stop.result)

    def _request_stop(self, stop: _Stop) -> "asyncio.Future[Values]":
        stop.latch = self.latch
        return self.line.submit(self, Priority.STOP, "Stop", stop.sent)

    async def _confirm_stop(self, stop: _Stop) -> StopOutcome:
        """Repeat a stop until its silence is confirmed, or its time is over.

        By a status in a latched state whose latch is newer than every one seen before, with the
        levels of all channels at zero: another one may be old, kept on its way.
        """
        cause, pause = "", _RAMP.from_wire(stop.ramp) + _INTERVAL
        try:
            async with asyncio.timeout_at(stop.ends) as stop.limit:
                while self.line.loss is None:
                    try:
                        requested, stop.requested = stop.requested, None
                        status = await (requested or self._request_stop(stop))
                        while _is_stopping(status, stop.latch):
                            if self.is_silent(status):
                                self.known = StopOutcome(True, threads.now())
                                return self.known
                            await asyncio.sleep(_INTERVAL)
                            status = await self.read_status(Priority.STOP)
                    except Exception as error:  # whatever it is, the stop goes on
                        cause = str(error) or type(error).__name__
                    await asyncio.sleep(pause)
        except TimeoutError:
            cause = cause or f"silence was not reported within {stop.timeout:g} s"
        return self.what_may_play(self.line.loss or cause)

    async def request(
        self,
        name: str,
        values: Values,
        priority: Priority = Priority.OTHER,
        *,
        timeout: float = REPLY_TIMEOUT,
    ) -> Values:
        """Send a request that needs nothing of the ledger; returns the values of its reply."""
        return await self.line.submit(self, priority, name, values, timeout=timeout)

    @property
    def statistics(self) -> LinkStatistics:
        """Counts of its requests, and of all frames on its line."""
        return replace(self.counts, **vars(self.line.wire.counters))

    async def _listen_for_another_host(self, status: Values) -> None:
        """Wait for a watchdog that rises unasked; raises LinkError."""
        end = threads.now() + LISTENING
        left = status["watchdog_left"]
        while threads.now() < end and status["state"] == ENABLED:
            await asyncio.sleep(LISTENING / 10)
            status = await self.read_status()
            self.check_other_host()
            if status["watchdog_left"] > left:
                raise driven_by_another(self.name)
            left = status["watchdog_left"]


def _is_stopping(status: Values, before: int | None) -> bool:
    """Whether a status shows that a stop was carried out since a latch was the newest."""
    if before is None or status["state"] not in LATCHED:
        return False
    return status["latch"] > 0 and is_newer_token(status["latch"], before)


def check_identity(identity: Values, name: str, serial_number: str | None) -> None:
    """Raise LinkError unless an amplifier of a name speaks this version and is the expected one.

    serial_number: the expected one, None for any.
    """
    if not identity["versions"] >> VERSION & 1:  # bit n: version n
        spoken = map(str, bits_of(identity["versions"]))
        raise WrongAmplifier(
            f"amplifier {name} speaks protocol {', '.join(spoken) or 'none'}, needs {VERSION}; "
            "update it"
        )
    serial = identity["serial_number"]
    if serial_number not in (None, serial):
        raise WrongAmplifier(
            f"amplifier {name}: serial number must be {serial_number}, got {serial}; connect the "
            "expected amplifier, or restart with this one"
        )


def check_capabilities(can: Values, name: str, *, is_output: bool | None) -> None:
    """Raise LinkError for capabilities that no amplifier can have, or other than the rig's.

    is_output: what the rig says of full level: the output of a linear amplifier, else a motion;
    None where there is no rig.
    """
    for each, low, stated, high in capability_ranges(can):
        if not low <= stated <= high:
            raise WrongAmplifier(f"amplifier {name}: {each} must be {low} to {high}, got {stated}")
    has_output = has_feature(can, "output")
    if is_output is not None and has_output is not is_output:
        raise WrongAmplifier(
            f"amplifier {name}: full level must be {_FULL_LEVEL[is_output]} as in the rig file, "
            f"got {_FULL_LEVEL[has_output]}; correct the rig file, or connect another amplifier"
        )


_MARGIN = 0.002  # s; of the amplifier's clock
_MAX_OVERDUE = 2.0  # s; after the end of the window: an emulator stands still meanwhile
_ROUNDING = 1e-6  # periods
_Q = QUANTITIES
_VIOLATION = "the amplifier does not keep the protocol"


@dataclass(frozen=True, slots=True)
class AmplifierSensor:
    """A sensor: its unit (a name of SENSOR_UNITS), and its range in it; frequency_max [Hz].

    channel: whose actuator it sits at, or None; x, y [m]: None where unknown.
    """

    unit: str
    channel: int | None
    x: float | None
    y: float | None
    range: float
    frequency_max: float


@dataclass(frozen=True, slots=True)
class SensorReading:
    """What a sensor measured: amplitude in its unit and phase [degrees] of each tone."""

    is_overloaded: bool
    tones: tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class Reading:
    """A reading: its number, its state (a name of READING_STATES), and what is left of it [s].

    start: the amplifier's clock at the start of its window, on which phases count. token: of what
    played then. sensors: empty until it is complete.
    """

    number: int
    state: str
    left: float
    start: int
    token: int
    tones: int
    sensors: tuple[SensorReading, ...]


async def read_sensors(amplifier: Amplifier) -> tuple[AmplifierSensor, ...]:
    """Read what its sensors measure, and where; empty if it has none."""
    if not has_feature(amplifier.ledger.capabilities, "sensors"):
        return ()
    found: list[AmplifierSensor] = []
    while True:
        listed = await amplifier.request("GetSensors", {"first": len(found)}, Priority.READING)
        found += [_sensor(each) for each in listed["sensors"]]
        if len(found) > listed["all"]:
            raise FrameError(f"sensors must be {listed['all']}, got {len(found)}; {_VIOLATION}")
        is_last = len(found) > _Q["sensor"].maximum or not listed["sensors"]
        if is_last or len(found) == listed["all"]:
            return tuple(found)


async def read_measured(amplifier: Amplifier) -> list[tuple[float, float]]:
    """Read voltage [V] and current [A] of each channel; empty if it does not measure them."""
    if not has_feature(amplifier.ledger.capabilities, "electrical"):
        return []
    measured = await amplifier.request("GetMeasured", {}, Priority.READING)
    voltage, current = _Q["channel_voltage"].from_wire, _Q["channel_current"].from_wire
    return [
        (voltage(row["channel_voltage"]), current(row["channel_current"]))
        for row in measured["channels"]
    ]


async def start_reading(
    amplifier: Amplifier, frequencies: Sequence[float], window: float
) -> Reading:
    """Begin to measure tones [Hz] at all sensors, over a window [s] from now on.

    Raises CommandError for tones that the window does not tell apart, CommandRefused for those
    beyond the sensors.
    """
    check_tones(frequencies, window)
    number = random.randint(_Q["reading"].minimum, _Q["reading"].maximum)  # noqa: S311  no secret
    values: Values = {
        "reading": number,
        "window": _Q["window"].to_wire(window),
        "tones": len(frequencies),
        "frequencies": [_Q["frequency"].to_wire(each) for each in frequencies],
    }
    found = await amplifier.request("Measure", values, Priority.READING)
    return _reading(found, number=number, tones=len(frequencies))


async def measure_tones(
    amplifier: Amplifier, frequencies: Sequence[float], window: float
) -> Reading:
    """Measure tones [Hz] at all sensors over a window [s] from now on, and wait for its end.

    Tones are in the order of the frequencies. The caller feeds the watchdog meanwhile, and has
    waited until the plate has settled. Raises what `start_reading` and `finish_reading` raise.
    """
    return await finish_reading(amplifier, await start_reading(amplifier, frequencies, window))


async def finish_reading(amplifier: Amplifier, started: Reading) -> Reading:
    """Wait for the end of a reading, and return it with all its sensors.

    Raises CommandRefused if another host has started one meanwhile, and FrameError if it does not
    end in time or lacks sensors.
    """
    found = started
    end = threads.now() + started.left + _MAX_OVERDUE
    while found.state == "RUNNING":
        if threads.now() > end:
            raise FrameError(
                f"reading {started.number} must be complete after its window, got {found.state} "
                f"{_MAX_OVERDUE:g} s later; {_VIOLATION}"
            )
        await asyncio.sleep(found.left + _MARGIN)
        found = await _same_reading(amplifier, started, 0)
    count = (await amplifier.request("GetSensors", {"first": 0}, Priority.READING))["all"]
    sensors = found.sensors
    more = sensors
    while more and len(sensors) < count:
        more = (await _same_reading(amplifier, started, len(sensors))).sensors
        sensors += more
    if len(sensors) != count:
        raise FrameError(f"reading must have all {count} sensors, got {len(sensors)}; {_VIOLATION}")
    return replace(found, sensors=sensors)


def check_tones(frequencies: Sequence[float], window: float) -> None:
    """Raise CommandError for tones [Hz] that a window [s] does not tell apart."""
    limit = _Q["tone_count"].maximum
    if not 1 <= len(frequencies) <= limit:
        raise CommandError(f"a reading must have 1 to {limit} tones, got {len(frequencies)}")
    apart = min(after - before for before, after in pairwise([0.0, *sorted(frequencies)]))
    if not apart * window >= 1 - _ROUNDING:
        raise CommandError(
            f"window must be at least a period of each frequency and of the differences between "
            f"them, 1/({apart:g} Hz), got {window:g} s"
        )


async def _same_reading(amplifier: Amplifier, started: Reading, first: int) -> Reading:
    """Read the reading that was started, its sensors from one on."""
    found = await amplifier.request("GetReading", {"first": first}, Priority.READING)
    return _reading(found, number=started.number, tones=started.tones)


def _sensor(values: Values) -> AmplifierSensor:
    channel = values["channel"]
    return AmplifierSensor(
        name_of(SENSOR_UNITS, values["unit"]),
        None if channel == NO_CHANNEL else channel,
        _place(values["x"]),
        _place(values["y"]),
        values["range"],
        _Q["frequency"].from_wire(values["frequency_max"]),
    )


def _place(at: int) -> float | None:
    return None if at == UNKNOWN_PLACE else _Q["place"].from_wire(at)


def _reading(values: Values, *, number: int, tones: int) -> Reading:
    """Read a reading of a number of tones, with its sensors.

    Raises CommandRefused for a reading of another number, FrameError for other tones.
    """
    if values["reading"] != number:
        raise CommandRefused(
            f"reading {number} was replaced by {values['reading'] or 'none'}: another host "
            "measures, or the amplifier has restarted; measure again"
        )
    if values["tones"] != tones:
        raise FrameError(
            f"reading {number} must have {tones} tones, got {values['tones']}; {_VIOLATION}"
        )
    count = values["count"]
    record = Record(Rows("sensors", count, sensor_reading(tones)))
    try:
        rows = record.unpack(values["sensors"], is_strict=False)["sensors"] if count else []
    except Refusal as refusal:
        raise FrameError(f"reading: {refusal}; {_VIOLATION}") from None
    return Reading(
        values["reading"],
        name_of(READING_STATES, values["state"]),
        _Q["window_left"].from_wire(values["window_left"]),
        values["window_start"],
        values["token"],
        tones,
        tuple(
            SensorReading(
                bool(row["flags"] & 1),
                tuple(
                    (tone["amplitude"], _Q["phase"].from_wire(tone["phase"]))
                    for tone in row["tones"]
                ),
            )
            for row in rows
        ),
    )
