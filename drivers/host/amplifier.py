"""One amplifier of protocol 4 on any wire: its identity, its requests and its measurements.

`Amplifier` identifies, arms, silences, disarms and stops one amplifier. The functions below it
measure its channels, and tones at its sensors; these requests need no session, do not feed the
watchdog and do not change what plays.
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
OPEN_TIMEOUT = 0.5  # s; for each reply while an amplifier is opened, also on a busy machine
_ARM_WITHIN = 3.0  # s; an Arm that is sent later than this after it was asked for is too late
CONFIRM_TIMEOUT = 0.3  # s; three replies of the slowest wire
LISTENING = 0.3  # s; how long the host listens for another one if it finds an armed amplifier
SECOND_REPLY = 0.02  # s; how long it waits for a second amplifier at the same address
_INTERVAL = 0.005  # s; between two attempts to stop, in addition to the ramp
_RAMP, _WATCHDOG = QUANTITIES["ramp"], QUANTITIES["watchdog"]
_ENERGISED = (STATES["SWITCHED_ON"], ENABLED)
_FULL_LEVEL = ("motion of a stiff source", "output of a linear amplifier")
_WIRE_ROUNDING = 0.5  # steps of the wire, beside half a step of the amplifier


@dataclass(eq=False, slots=True)
class _Stop:
    """A stop, which is repeated until the amplifier has confirmed it or a timeout has passed."""

    ramp: int
    """In units of the wire."""
    timeout: float
    """How long it is repeated after the first request has gone out [s]."""
    ends: float
    """When the timeout passes [s]."""
    is_sent: bool = False
    """Whether the first request has gone out; what is played later needs a stop of its own."""
    limit: asyncio.Timeout | None = None
    requested: "asyncio.Future[Values] | None" = None
    """The first request, which is queued as soon as the stop is asked for."""
    latch: int | None = None
    """The newest latch that was known when the last request was made."""
    result: "asyncio.Future[StopOutcome]" = field(init=False)

    def sent(self) -> list[Values]:
        """Return the values of the request, and note that it goes out now."""
        if not self.is_sent:
            self.is_sent = True
            self.ends = threads.now() + self.timeout
            if self.limit is not None:
                self.limit.reschedule(self.ends)
        return [{"ramp": self.ramp}]


class Amplifier(Dialogue):
    """An amplifier on an open line.

    limits: the configured ones. serial_number: the expected one; None for any. is_output: what full
    level means by the rig: True for the output of a linear amplifier, False for the motion of a
    stiff source, None for either.
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
        """Adopt what was known of the same amplifier before its line was opened again."""
        self.known = replace(before.what_may_play(), is_confirmed=before.known.is_confirmed)
        self.may_be_armed = before.may_be_armed

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

        timeout: for each reply [s]. The newest latch is then that of this status, since the
        amplifier may have lost its supply before.
        """
        self._are_several = False
        try:
            identity = await self.request("Hello", {}, Priority.OTHER, timeout=timeout)
            await asyncio.sleep(SECOND_REPLY)
        except LinkTimeout:
            self._check_alone()
            raise
        self._check_alone()
        # Until it is identified it may be another amplifier, whose silence confirms nothing.
        shown, self.capabilities = self.capabilities, {}
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
        """Raise LinkError if several amplifiers replied: the silence of one confirms nothing."""
        if self._are_several:
            self.capabilities = {}
            raise WrongAmplifier(
                f"amplifier {self.name}: several amplifiers reply at address {self.address} on "
                f"{self.line.name}; give each its own: era amp address --serial-number"
            )

    def arm(self, session: int, watchdog: float = WATCHDOG) -> Coroutine[Any, Any, Values]:
        """Switch the high voltage on at level zero, and return the status; watchdog [s].

        The amplifier is identified anew, since it may have lost its supply and come back with other
        limits. A stop or disarm that comes after this call goes first, even before it is awaited.
        """
        self.arming = self.silences, threads.now() + _ARM_WITHIN
        return self._arm(session, watchdog)

    async def _arm(self, session: int, watchdog: float) -> Values:
        # The timeout is short so that the watchdogs of other armed amplifiers do not run down.
        await self.identify(timeout=REPLY_TIMEOUT)
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
        """Read what the amplifier plays of a layer of the set with this token.

        The ledger uses the result from then on. A layer that continues an earlier set is returned
        as it was sent. Raises CommandRefused if the amplifier contradicts two sets in a row.
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
        status = await self.request("Disarm", {"ramp": self.wire_ramp(ramp)}, Priority.SILENCE)
        end = threads.now() + ramp + CONFIRM_TIMEOUT
        while status["state"] in _ENERGISED or not self.is_silent(status):
            if threads.now() > end or status["state"] == ENABLED:
                raise CommandRefused(f"amplifier {self.name} is not silent after a disarm")
            await asyncio.sleep(_INTERVAL)
            status = await self.read_status(Priority.SILENCE)
        self.may_be_armed = False

    def ping(self) -> "asyncio.Future[Values]":
        """Feed the watchdog and steer the clock; returns a future of the status.

        The future raises CommandRefused if the amplifier is not armed.
        """

        def make() -> list[Values]:
            is_playing = self._ledger is not None and any(self._ledger.playback.all_voices)
            rate = self.clock.rate(self._time(), is_playing=is_playing)
            return [{"session": self.session, "rate": rate}]

        return self.line.submit(self, Priority.HEARTBEAT, "Ping", make)

    def read_status(self, priority: Priority = Priority.OTHER) -> "asyncio.Future[Values]":
        """Read the status; this does not feed the watchdog."""
        return self.line.submit(self, priority, "GetStatus", {})

    async def clear(self) -> Values:
        """Acknowledge the newest stop or fault that the amplifier has shown.

        The amplifier is identified anew: if it has lost its supply it counts latches from 1 again.
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
        """Stop along a ramp [s] and latch; the request is queued when this returns.

        The future ends once silence is confirmed, or when a timeout [s] has passed after the
        request went out. Calls before that join the same stop, which goes on if a caller is
        cancelled.
        """
        stop = self._stop
        if stop is None or stop.is_sent or stop.result.done():
            members, wire_ramp = len(self.line.members), self.wire_ramp(ramp)
            # On a shared line each amplifier has three exchanges: a stop and two statuses.
            timeout += ATTEMPTS * members * self.exchange_time("GetStatus")
            timeout += _RAMP.from_wire(wire_ramp)
            ends = threads.now() + timeout * (members + 1)  # others may keep the line busy
            self._stop = stop = _Stop(wire_ramp, timeout, ends)
            stop.result = asyncio.ensure_future(self._confirm_stop(stop))
            with contextlib.suppress(Exception):  # then `_confirm_stop` makes the request
                stop.requested = self._request_stop(stop)
        return asyncio.shield(stop.result)

    def _request_stop(self, stop: _Stop) -> "asyncio.Future[Values]":
        stop.latch = self.latch
        return self.line.submit(self, Priority.STOP, "Stop", stop.sent)

    async def _confirm_stop(self, stop: _Stop) -> StopOutcome:
        """Repeat a stop until its silence is confirmed, or its timeout has passed.

        A status confirms it if its state is latched, its latch is newer than each one seen before,
        and the levels of all channels are zero. Any other status may be old and only late.
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
                    except Exception as error:  # the stop goes on, whatever has failed
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
        """Send a request that the ledger need not admit; returns the values of its reply."""
        return await self.line.submit(self, priority, name, values, timeout=timeout)

    @property
    def statistics(self) -> LinkStatistics:
        """Counts of the requests to this amplifier, and of all frames on its line."""
        return replace(self.counts, **vars(self.line.wire.counters))

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


def _is_stopping(status: Values, before: int | None) -> bool:
    """Whether a status shows a stop that was carried out after this latch was the newest."""
    if before is None or status["state"] not in LATCHED:
        return False
    return status["latch"] > 0 and is_newer_token(status["latch"], before)


def check_identity(identity: Values, name: str, serial_number: str | None) -> None:
    """Raise LinkError unless an amplifier speaks this version and has the expected serial number.

    name: of the amplifier, for the message. serial_number: None for any.
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
    """Raise LinkError for capabilities that no amplifier can have, or that contradict the rig.

    is_output: as of `Amplifier`; None also where there is no rig.
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


_MARGIN = 0.002  # s; by which the amplifier's clock may be late at the end of a window
_MAX_OVERDUE = 2.0  # s; after the end of the window; an emulator may stand still for a while
_ROUNDING = 1e-6  # periods
_Q = QUANTITIES
_VIOLATION = "the amplifier does not keep the protocol"


@dataclass(frozen=True, slots=True)
class AmplifierSensor:
    """A sensor of an amplifier, as it describes it."""

    unit: str
    """A name of `SENSOR_UNITS`."""
    channel: int | None
    """The channel whose actuator it sits at; None if it sits at none."""
    x: float | None
    """Place on the plate [m]; None if the amplifier does not know it."""
    y: float | None
    """As x."""
    range: float
    """Largest amplitude that it measures, in its unit."""
    frequency_max: float
    """Highest frequency that it measures [Hz]."""


@dataclass(frozen=True, slots=True)
class SensorReading:
    """What a sensor measured."""

    is_overloaded: bool
    tones: tuple[tuple[float, float], ...]
    """Amplitude in the sensor's unit and phase [degrees] of each tone."""


@dataclass(frozen=True, slots=True)
class Reading:
    """A measurement of tones at all sensors of an amplifier over a window."""

    number: int
    state: str
    """A name of `READING_STATES`."""
    left: float
    """Time until its window ends [s]."""
    start: int
    """The amplifier's clock at the start of the window, from which phases count."""
    token: int
    """Token of the set that played then."""
    tones: int
    """Number of tones."""
    sensors: tuple[SensorReading, ...]
    """Empty until the reading is complete."""


async def read_sensors(amplifier: Amplifier) -> tuple[AmplifierSensor, ...]:
    """Read the descriptions of an amplifier's sensors; empty if it has none."""
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
    """Begin to measure tones [Hz] at all sensors over a window [s] that starts now.

    Raises CommandError for tones that the window cannot tell apart, and CommandRefused for tones
    that the sensors cannot measure.
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
    """Measure tones [Hz] at all sensors over a window [s] that starts now, and wait for its end.

    The tones of the result are in the order of the frequencies. The caller must wait until the
    plate has settled before, and feed the watchdog during the reading. Raises what `start_reading`
    and `finish_reading` raise.
    """
    return await finish_reading(amplifier, await start_reading(amplifier, frequencies, window))


async def finish_reading(amplifier: Amplifier, started: Reading) -> Reading:
    """Wait for the end of a reading, and return it with all its sensors.

    Raises CommandRefused if another host has started a reading meanwhile, and FrameError if this
    one does not end in time or lacks sensors.
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
    """Raise CommandError for tones [Hz] that a window [s] cannot tell apart."""
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
    """Read a reading that was started, with its sensors from this index on."""
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
    """Return the reading that a reply describes.

    Raises CommandRefused if its number is another one, FrameError for another count of tones.
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
