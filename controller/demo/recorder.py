"""The simulated plate of the demonstration, and a row for every touch on it.

`simulated_plate` starts amplifiers in a process of their own behind a real wire. The controller
reaches them over the wire only; `SimulatedPlate` places the fingers and reads their vibration over
the control socket. `TouchRecorder` observes the control loop and makes a `TouchRow` of each touch,
with predicted and measured values.
"""

import asyncio
import contextlib
import json
import math
import os
import sys
import tempfile
from collections.abc import AsyncIterator, Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias, cast
from urllib.parse import quote

import numpy as np
from pydantic import BaseModel, ValidationError

from controller.play.intent import FingerSensation
from controller.play.reports import Observers, PlayReport
from controller.process.child import ended
from controller.sources.touch import Change, Contact, ContactKey
from drivers.errors import LinkError
from model.answer.answer import HELD_BACK, Layer
from model.arrays import FloatArray
from model.finger import DEFAULT_THRESHOLD, mean_level_db_sl, sensation_level
from model.quantities import counted
from registry import threads
from registry.virtual_time import VirtualTimeLoop
from registry.wording import first_problem

_Position: TypeAlias = tuple[float, float]

_SAME_FREQUENCY = 1.0
"""Difference [Hz] within which a tone belongs to a content, due to rounding by the amplifier."""


@dataclass(frozen=True)
class FingerVibration:
    """Measured vibration of a fingertip over a time window, at p points of the tip."""

    frequencies: FloatArray
    """Frequencies (f,) [Hz]."""
    amplitudes: FloatArray
    """Amplitudes (f, p) [m/s²] of the steady part."""
    weights: FloatArray
    """Weights (p,) of the points in the mean over the tip."""
    thresholds: tuple[str, ...] = (DEFAULT_THRESHOLD,)
    """Threshold sets: levels refer to the first, contrasts are the lowest of all sets."""

    @property
    def level_db_sl(self) -> float:
        """Sensation level, mean over the tip; -inf without vibration."""
        return self.level_by(self.thresholds[0])

    @property
    def loudest_db_sl(self) -> float:
        """Sensation level at the loudest point of the tip; -inf without vibration."""
        return self.loudest_by(self.thresholds[0])

    def level_by(self, threshold: str) -> float:
        """Sensation level relative to a threshold set by name, mean over the tip."""
        return mean_level_db_sl(self.frequencies, self.amplitudes, self.weights, threshold)

    def loudest_by(self, threshold: str) -> float:
        """Sensation level relative to a threshold set by name, at the loudest point of the tip."""
        return float(sensation_level(self.frequencies, self.amplitudes, threshold).max())

    def parted(self, frequency: float) -> tuple["FingerVibration", "FingerVibration"]:
        """Split into the part at a content's frequency [Hz] and the rest."""
        is_own = np.abs(self.frequencies - frequency) < _SAME_FREQUENCY
        own, others = (
            replace(self, frequencies=self.frequencies[some], amplitudes=self.amplitudes[some])
            for some in (is_own, ~is_own)
        )
        return own, others


@dataclass(frozen=True, kw_only=True)
class FingerRow:
    """A finger among several contents: frequency, verdict, and promised and measured values.

    A contrast is its own level above the level of all other contents' total power here. Measured
    contrasts are None without a measured own or other content.
    """

    at_m: _Position
    frequency_hz: float | None
    verdict: str
    promised_contrast_db: float | None
    measured_contrast_db: float | None
    measured_level_db_sl: float | None


@dataclass(frozen=True, kw_only=True)
class TouchRow:
    """A touch from touch-down to lift, with its last steady pattern with the most contents.

    Its fields are the keys of `era demo --json`, except those in `_OWN`:

    - quiet: other fingertips by id [m].
    - pattern, levels_db_sl: levels by id: for the target the mean over its tip, for other fingers
      the loudest point. The smallest difference is the contrast.
    - Contrasts are None for a single finger; measured ones also if the pattern was too short.
      Predicted values are for the table's plate; 90 % of plates within the tolerances reach the
      promised levels.
    - drive: as achieved by the amplifiers, by ERA.
    - latency_ms: from touch frame to last byte on the wire; None in virtual time.
    - reason: why nothing played, if so.
    - fingers: one for each of several contents; contrasts are then relative to the other contents
      at this finger.
    - contents: their patterns, in the order of layers.
    """

    target_id: str
    time_s: float
    until_s: float
    targets_m: Sequence[_Position]
    quiet: Mapping[str, _Position]
    reason: str | None = None
    drive: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    mode: str | None = None
    latency_ms: float | None = None
    played_s: float = 0.0
    steady: bool = False
    predicted_contrast_db: float | None = None
    promised_contrast_db: float | None = None
    measured_contrast_db: float | None = None
    predicted_level_db_sl: float | None = None
    measured_level_db_sl: float | None = None
    pattern: Layer | None = None
    levels_db_sl: Mapping[str, float] = field(default_factory=dict)
    fingers: Sequence[FingerRow] = ()
    contents: Sequence[Layer] = ()

    @property
    def keeps_promise(self) -> bool | None:
        """Whether the steady felt contrast is at least the promised one; None if not measured."""
        promised, measured = self.promised_contrast_db, self.measured_contrast_db
        if not self.steady or promised is None or measured is None:
            return None
        return measured >= promised

    def as_json(self) -> dict[str, Any]:
        """Return the row in the format of `era demo --json`."""
        row = {each.name: getattr(self, each.name) for each in fields(self)}
        row = {key: row[key] for key in row if key not in _OWN}
        row["quiet_m"] = list(self.quiet.values())
        if self.fingers:
            row["fingers"] = [asdict(each) for each in self.fingers]
        return row


_OWN = ("target_id", "quiet", "pattern", "levels_db_sl", "fingers", "contents")


def steady_contrast_db(target: FingerVibration, others: Sequence[FingerVibration]) -> float | None:
    """Level of the target above the loudest point of others [dB], steady; None without others.

    As promised contrasts, the least over the threshold sets of the target.
    """
    if not others:
        return None
    contrasts = []
    for threshold in target.thresholds:
        loudest = max(other.loudest_by(threshold) for other in others)
        contrasts.append(target.level_by(threshold) - loudest)
    return min(contrasts)


SIMULATED_WATCHDOG = 2.0
"""Watchdog [s] of simulated amplifiers, the longest of the protocol: their machine may be busy."""

STARTUP_TIMEOUT = 120.0  # s; solving the plate takes long on a busy machine
EXIT_TIMEOUT = 3.0  # s
_REPLY_TIMEOUT = 30.0  # s; long enough for a busy machine
_MAX_REPLY = 1 << 20  # bytes; a reply for ten fingers takes a fiftieth of this
_REMEDY = "see its output above and start the demonstration again"

SIM_OPTIONS: Mapping[str, Sequence[str]] = {
    "serial": ("--serial", "--shared"),
    "modbus": ("--modbus-tcp", "0"),
    "can": ("--socketcand", "0"),
    "firmware": ("--firmware",),
}
"""Options of `era sim` by wire; amplifiers share a bus, so that they start together."""


class SimulatedPlate:
    """The plate behind the amplifiers, with their URLs by name; methods raise LinkError.

    control: path of its control socket; each request has a connection of its own, so that no finger
    waits for a vibration.
    """

    def __init__(
        self,
        control: Path,
        urls: Mapping[str, str],
        *,
        thresholds: Sequence[str] = (DEFAULT_THRESHOLD,),
    ) -> None:
        self.urls = urls
        self._control = control
        self._thresholds = tuple(thresholds)
        self._placing = asyncio.Lock()  # fingers are placed in order

    async def place_fingers(
        self, positions: Mapping[str, _Position], loads: Mapping[str, float] = MappingProxyType({})
    ) -> None:
        """Place fingers at positions [m] by id, loads by id, too; all others are removed."""
        async with self._placing:
            await self._request("fingers", fingers=dict(positions), loads=dict(loads))

    async def vibration(self, since: float, until: float) -> dict[str, FingerVibration]:
        """Vibration of each finger by id between two times [s] of time.monotonic()."""
        reply = await self._request("felt", since_s=since, until_s=until)
        return {
            id: FingerVibration(
                frequencies=np.array(felt.frequencies_hz),
                amplitudes=np.array(felt.amplitude_m_s2).reshape(
                    len(felt.frequencies_hz), len(felt.weights)
                ),
                weights=np.array(felt.weights),
                thresholds=self._thresholds,
            )
            for id, felt in reply.fingers.items()
        }

    async def _request(self, op: str, **values: object) -> "_Reply":
        """Return the reply to a request; raises LinkError without a reply or for an error."""
        try:
            async with asyncio.timeout(_REPLY_TIMEOUT):
                path = str(self._control)
                reader, writer = await asyncio.open_unix_connection(path, limit=_MAX_REPLY)
                with contextlib.closing(writer):
                    writer.write(json.dumps({"op": op, **values}).encode() + b"\n")
                    reply = _Reply.model_validate_json(await reader.readline())
        except (OSError, ValueError) as error:  # a missing or incomplete line is not JSON
            why = str(error) or "it took too long"
            if isinstance(error, ValidationError):
                why = " ".join(first_problem(error))
            raise LinkError(
                f"simulated plate at {self._control}: no reply to {op} ({why}); {_REMEDY}"
            ) from error
        if reply.error is not None:
            raise LinkError(f"simulated plate: {op} refused: {reply.error}")
        return reply


class _FingerRecord(BaseModel):
    """Vibration of a finger, as the control socket has it."""

    frequencies_hz: list[float]
    amplitude_m_s2: list[list[float]]
    weights: list[float]


class _Reply(BaseModel):
    """The fields used from a reply of the control socket."""

    error: str | None = None
    fingers: dict[str, _FingerRecord] = {}


@contextlib.asynccontextmanager
async def simulated_plate(
    rig_file: Path,
    amplifiers: Collection[str],
    *,
    wire: str,
    seed: int | None = 0,
    thresholds: Sequence[str] = (DEFAULT_THRESHOLD,),
) -> AsyncIterator[SimulatedPlate]:
    """Simulate the amplifiers of a rig file for the duration of the context.

    wire: a key of `SIM_OPTIONS` for a process of their own, "sim" for a plate in this process;
    seed: of the plate within the rig's uncertainty, None for the rig's own; thresholds: see
    `FingerVibration`. Raises LinkError if the process does not start.
    """
    with tempfile.TemporaryDirectory(prefix="era-") as folder:
        path = Path(folder) / "control"
        async with contextlib.AsyncExitStack() as stack:
            if wire == "sim":
                plate = "exact" if seed is None else f"seed={seed}"
                base = f"sim://{quote(os.fsencode(rig_file))}?control={quote(os.fsencode(path))}&{plate}&amplifier="
                urls = {name: base + quote(name) for name in amplifiers}
            else:
                process = await start_simulation(rig_file, wire=wire, control=path, seed=seed)
                stack.push_async_callback(end_simulation, process)
                urls = await _read_urls(process, count=len(amplifiers))
            yield SimulatedPlate(path, urls, thresholds=thresholds)


async def start_simulation(
    rig_file: Path, *, wire: str, control: Path, seed: int | None
) -> asyncio.subprocess.Process:
    """Start simulated amplifiers as a process that ends with this one."""
    return await asyncio.create_subprocess_exec(
        # -P: do not import a folder named sim in the working directory
        sys.executable,
        "-P",
        "-m",
        "sim",
        str(rig_file),
        *SIM_OPTIONS[wire],
        *(("--exact",) if seed is None else ("--seed", str(seed))),
        "--control",
        str(control),
        "--until-eof",  # ends with the pipe below, however this process ends
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        start_new_session=True,  # Ctrl-C must not end the amplifiers before they are silenced
    )


async def _read_urls(process: asyncio.subprocess.Process, *, count: int) -> dict[str, str]:
    """Read a line `NAME: URL` per amplifier from the process."""
    urls: dict[str, str] = {}
    assert process.stdout is not None  # noqa: S101  a pipe was requested
    try:
        async with asyncio.timeout(STARTUP_TIMEOUT):
            while len(urls) < count and (line := (await process.stdout.readline()).decode()):
                name, _, url = line.strip().partition(": ")
                urls[name] = url
    except TimeoutError:
        reason = f"not ready within {STARTUP_TIMEOUT:g} s"
        raise LinkError(f"simulated amplifiers: {reason}; {_REMEDY}") from None
    if len(urls) < count:
        status = await process.wait()
        raise LinkError(f"simulated amplifiers: exited with status {status}; {_REMEDY}")
    return urls


async def end_simulation(process: asyncio.subprocess.Process) -> None:
    """Terminate the process of simulated amplifiers, and wait until it has ended."""
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    await ended(process, EXIT_TIMEOUT)


STEADY_WINDOW = 0.25
"""Time [s] over which a pattern is measured: settled, and it separates tones 10 Hz apart.

It is the end of the longest time in which no finger lands, moves or lifts.
"""

_MARGIN = 0.005
"""Time [s] from the last byte on the wire to the plate, and before the next command."""

STEADY_DURATION = 0.4
"""Shortest pattern [s] that counts as steady; the plate rings for 50 ms to 1 s."""

_MAX_DELAY = STEADY_DURATION - STEADY_WINDOW
"""Delay [s] of a pattern or of a finger's sensor from which a steady window may contain it."""

Measured: TypeAlias = asyncio.Task[dict[str, FingerVibration]]

_NOT_THE_TARGET = "another finger came down at the same moment and was the target"

MIN_MOVEMENT = 0.001
"""Movement [m] below which a finger's sensor stays in place, so that its window is not broken."""


@dataclass(eq=False)
class _Touch:
    """A touch and the patterns that were played for it."""

    contact: Contact
    quiet: Mapping[str, _Position]
    until: float = math.inf
    patterns: list["_PlayedPattern"] = field(default_factory=list)
    reason: str | None = None


@dataclass(eq=False)
class _PlayedPattern:
    """A pattern from its commit to the next command [s], with its measurements."""

    applied: PlayReport
    touches: Sequence[_Touch]
    """Touches that feel a content."""
    until: float = math.inf
    steady: Measured | None = None
    """Vibration by finger over the longest time in which no finger moved."""

    @property
    def duration(self) -> float:
        return self.until - self.applied.time


class TouchRecorder:
    """Collects a row per touch: pass `observe` to the daemon.

    tasks: group of the tasks that measure and make rows; once it has ended, all rows are made.
    on_row: called with each row once the touch was lifted and its pattern measured.
    Times of rows count from `start`.
    """

    def __init__(
        self,
        plate: SimulatedPlate,
        tasks: asyncio.TaskGroup,
        *,
        on_row: Callable[[TouchRow], None],
    ) -> None:
        self.rows: list[TouchRow] = []
        self.touches: dict[ContactKey, _Touch] = {}
        """Current touches."""
        self.fault: str | None = None
        """Why the plate is no longer armed; None while armed, and before."""
        self.faults: list[str] = []
        """Every cause of disarming so far."""
        self.rejected_sets = 0
        """Number of sets that an amplifier or its ledger has rejected."""
        self.worst_delay = 0.0
        """Longest time [s] from a touch to its pattern, or for the plate's sensors to follow."""
        self._is_armed = asyncio.Event()
        self._plate = plate
        self._tasks = tasks
        self._on_row = on_row
        self._start = threads.now()
        self._playing: _PlayedPattern | None = None
        self._changes: list[float] = []  # when fingers landed, moved or lifted
        self._sensors: dict[str, _Position] = {}
        self._loads: dict[str, float] = {}

    def observe(self, loop: Observers) -> None:
        """Observe the reports of the control loop."""
        loop.contacts_changed.append(self._contacts_changed)
        loop.reported.append(self._reported)
        loop.refused.append(self._set_rejected)

    def why_void(self) -> str | None:
        """Return why a real-time run is void; None if it is valid."""
        if self.faults:
            return f"the amplifiers stopped ({self.faults[0]})"
        if self.worst_delay > _MAX_DELAY:
            delay_ms = 1000 * self.worst_delay
            return f"a reaction took {delay_ms:.0f} ms, more than {1000 * _MAX_DELAY:.0f} ms"
        if self.rejected_sets:
            return f"amplifiers rejected {counted(self.rejected_sets, 'set')}"
        return None

    async def start(self) -> None:
        """Wait until the plate is armed, and set the start of the recording to then."""
        await self._is_armed.wait()
        self._start = threads.now()

    def armed(self) -> None:
        """Note that the plate is armed, again after a fault."""
        self.fault = None
        self._is_armed.set()

    def failed(self, cause: str) -> None:
        """Note that the plate is armed no longer; rows of touches that this spoils say so."""
        self.fault = cause.partition("; ")[0]  # without its remedy
        self.faults.append(self.fault)
        since = -math.inf if self._playing is None else self._playing.applied.time
        self._end_pattern(threads.now(), is_measured=False)  # silent since a time that is not known
        for touch in self.touches.values():
            if touch.contact.since > since:
                touch.reason = self.fault

    def _contacts_changed(self, contacts: tuple[Contact, ...], change: Change) -> None:
        self._move_sensors(contacts)
        if change.down or change.up:
            self._changes.append(threads.now())
        for contact in change.down:
            others = {_id(other): _place(other) for other in contacts if other != contact}
            self.touches[contact.key] = _Touch(contact, others, reason=self.fault)
        for contact in change.up:
            touch = self.touches.pop(contact.key)
            touch.contact, touch.until = contact, threads.now()
            self._complete(touch)

    def _reported(self, applied: PlayReport) -> None:
        self._end_pattern(applied.time)
        if applied.contents:
            for each in self.touches.values():
                each.reason = each.reason or _NOT_THE_TARGET
        touches = []
        for felt in applied.targets:
            touch = self.touches.get(felt.contact.key)
            if touch is not None and felt.sensation.verdict == HELD_BACK:
                touch.reason = applied.reason or felt.held_back
            elif touch is not None:  # not lifted meanwhile
                touches.append(touch)
        if touches:
            self._playing = _PlayedPattern(applied, touches)
            self._note_delay(applied.latency or 0.0)
        for touch in touches:
            touch.patterns.append(cast(_PlayedPattern, self._playing))

    def _end_pattern(self, now: float, *, is_measured: bool = True) -> None:
        """Close the playing pattern and measure its end."""
        ended, self._playing = self._playing, None
        if ended is None:
            return
        ended.until = now
        # Its end is reported with the reply to what ended it, some time after the fingers changed.
        settled = ended.applied.time + ended.applied.layer.ramp
        changes = [each for each in self._changes if settled < each < now]
        start, end = max(pairwise([settled, *changes, now]), key=lambda rest: rest[1] - rest[0])
        since, until = max(start, end - STEADY_WINDOW) + _MARGIN, end - _MARGIN
        self._changes = changes
        if is_measured and since < until:
            ended.steady = self._tasks.create_task(self._plate.vibration(since, until))
        for touch in ended.touches:
            self._complete(touch)

    def _complete(self, touch: _Touch) -> None:
        """Make the row of a touch once it is lifted and nothing plays for it."""
        is_playing = self._playing is not None and touch in self._playing.touches
        if touch.until < math.inf and not is_playing:
            self._tasks.create_task(self._add_row(touch))

    def _move_sensors(self, contacts: tuple[Contact, ...]) -> None:
        """Make the plate's sensors follow the fingers."""
        sensors = {}
        for contact in contacts:
            position = _place(contact)
            before = self._sensors.get(_id(contact), (math.inf, math.inf))
            is_at_rest = math.dist(before, position) < MIN_MOVEMENT
            sensors[_id(contact)] = before if is_at_rest else position
        if any(sensors.get(id, position) != position for id, position in self._sensors.items()):
            self._changes.append(threads.now())
        loads = {_id(contact): contact.load for contact in contacts}
        if sensors != self._sensors or loads != self._loads:
            self._sensors, self._loads = sensors, loads
            self._tasks.create_task(self._place_sensors(sensors, loads))

    async def _place_sensors(
        self, sensors: Mapping[str, _Position], loads: Mapping[str, float]
    ) -> None:
        """Place the plate's sensors and note how long that took."""
        started_at = threads.now()
        await self._plate.place_fingers(sensors, loads)
        self._note_delay(threads.now() - started_at)

    def _note_delay(self, delay: float) -> None:
        self.worst_delay = max(self.worst_delay, delay)

    def _set_rejected(self, reason: str) -> None:
        self.rejected_sets += 1

    async def _add_row(self, touch: _Touch) -> None:
        """Make the row of a lifted touch."""
        contact = touch.contact
        row = TouchRow(
            target_id=_id(contact),
            time_s=contact.since - self._start,
            until_s=touch.until - self._start,
            targets_m=[_place(contact)],
            quiet=touch.quiet,
            reason=touch.reason or "no vibration was confirmed before it lifted",
        )
        if touch.patterns:
            row = await _played(touch, row)
        self.rows.append(row)
        self._on_row(row)


async def _played(touch: _Touch, row: TouchRow) -> TouchRow:
    """Complete a row with the last steady pattern with the most contents, or the longest of them.

    All fingers of a pattern use the same pattern, so that their rows refer to the same moment. The
    latency is that of the touch's first pattern.
    """
    main_part = max(touch.patterns, key=_significance)
    latency = touch.patterns[0].applied.latency
    if isinstance(asyncio.get_running_loop(), VirtualTimeLoop):
        latency = None
    key = touch.contact.key
    applied = main_part.applied
    predicted = next(felt for felt in applied.targets if felt.contact.key == key)
    played = next(  # its own content, or the content it shares
        each for each in applied.contents.values() if key in each.content.contact_keys
    )
    pattern = played.layer
    vibration = await main_part.steady if main_part.steady else {}
    row = replace(
        row,
        reason=None,
        targets_m=[_place(predicted.contact)],
        quiet={_id(other): _place(other) for other in applied.quiet},
        drive={
            era: {"frequency_hz": each.frequency, "level": each.level, "phase_deg": each.phase}
            for era, each in played.drive.items()
        },
        mode=pattern.drive_mode,
        latency_ms=None if latency is None else 1000 * latency,
        played_s=main_part.duration,
        steady=main_part.duration >= STEADY_DURATION,
        predicted_contrast_db=predicted.sensation.contrast_db,
        promised_contrast_db=predicted.sensation.promised_contrast_db,
        predicted_level_db_sl=predicted.level_db_sl,
        pattern=pattern,
        levels_db_sl={
            id: finger.level_db_sl if id == row.target_id else finger.loudest_db_sl
            for id, finger in vibration.items()
        },
    )
    if len(applied.contents) > 1:
        own = _finger_row(predicted, vibration)
        return replace(
            row,
            measured_contrast_db=own.measured_contrast_db,
            measured_level_db_sl=own.measured_level_db_sl,
            fingers=[_finger_row(each, vibration) for each in applied.targets],
            contents=[each.layer for each in applied.contents.values()],
        )
    target, quiet = _fingers(vibration, predicted, applied.quiet)
    return replace(
        row,
        measured_contrast_db=steady_contrast_db(target, quiet) if target else None,
        measured_level_db_sl=target.level_db_sl if target else None,
    )


def _significance(pattern: _PlayedPattern) -> tuple[int, float, float]:
    """Order of patterns: by contents, then by steadiness, then by time."""
    applied = pattern.applied
    return len(applied.contents), min(pattern.duration, STEADY_DURATION), applied.time


def _finger_row(felt: FingerSensation, vibration: Mapping[str, FingerVibration]) -> FingerRow:
    """Make the row of a finger among several contents."""
    level = contrast = None
    measured = vibration.get(_id(felt.contact))
    if measured is not None and felt.frequency is not None:
        own, others = measured.parted(felt.frequency)
        if math.isfinite(own.level_db_sl):
            level = own.level_db_sl
            contrast = steady_contrast_db(own, [others])
    return FingerRow(
        at_m=_place(felt.contact),
        frequency_hz=felt.frequency,
        verdict=felt.sensation.verdict,
        promised_contrast_db=felt.sensation.promised_contrast_db,
        measured_contrast_db=contrast if contrast != math.inf else None,
        measured_level_db_sl=level,
    )


def _fingers(
    vibration: Mapping[str, FingerVibration], felt: FingerSensation, others: Sequence[Contact]
) -> tuple[FingerVibration | None, list[FingerVibration]]:
    """Return the vibration of target and quiet fingers; no target unless all were measured."""
    target = vibration.get(_id(felt.contact))
    quiet = [vibration[_id(each)] for each in others if _id(each) in vibration]
    if target is None or not len(target.frequencies) or len(quiet) < len(others):
        return None, []
    return target, quiet


def _place(contact: Contact) -> _Position:
    return contact.x, contact.y


def _id(contact: Contact) -> str:
    """The id of a contact's sensor on the plate."""
    return f"{contact.key.source}#{contact.key.id}"
