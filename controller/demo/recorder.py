"""The simulated plate of the demonstration, and a row for every touch on it.

`simulated_plate` starts amplifiers in a process of their own behind a real wire. The controller
reaches them over the wire only; `SimulatedPlate` places the fingers and reads their vibration over
the control socket. `TouchRecorder` is a client of the daemon: it follows the events of its API, as
any program can, and makes a `TouchRow` of each touch, with what was promised for it and what was
measured.
"""

import asyncio
import contextlib
import json
import math
import os
import sys
import tempfile
from collections.abc import AsyncIterator, Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias, TypeVar
from urllib.parse import quote

import numpy as np

from controller.api.client import AsyncClient
from controller.api.link import Notification
from controller.api.methods import ContactsEvent, PatternEvent, SilenceEvent, StateEvent
from controller.api.schema import MAX_RATE, ApiMessage, ContactStatus, PlayedTone
from controller.operation.operation_states import DaemonState
from controller.play.slots import CROSSFADE
from controller.process.child import ended
from drivers.errors import LinkError
from model.answer.answer import HELD_BACK
from model.answer.stimulus import ONSET_RAMP
from model.arrays import FloatArray
from model.finger import DEFAULT_THRESHOLD, mean_level_db_sl, sensation_level
from registry import threads

Position: TypeAlias = tuple[float, float]

_T = TypeVar("_T")
_MessageT = TypeVar("_MessageT", bound=ApiMessage)

SAME_FREQUENCY = 1.0
"""Difference [Hz] within which a tone is that of a content, as its amplifier has rounded it."""


@dataclass(frozen=True)
class FingerVibration:
    """Measured vibration of one fingertip over a window, at p points of the tip."""

    frequencies: FloatArray
    """Frequencies (f,) [Hz]."""
    amplitudes: FloatArray
    """Amplitudes (f, p) [m/s²] of the steady part."""
    weights: FloatArray
    """Weights (p,) of the points in the mean over the tip."""
    threshold: str = DEFAULT_THRESHOLD
    """Name of the set of thresholds that levels refer to."""

    @property
    def level_db_sl(self) -> float:
        """Sensation level, mean over the tip; -inf without vibration."""
        return mean_level_db_sl(self.frequencies, self.amplitudes, self.weights, self.threshold)

    @property
    def loudest_db_sl(self) -> float:
        """Sensation level at the loudest point of the tip; -inf without vibration."""
        return float(sensation_level(self.frequencies, self.amplitudes, self.threshold).max())

    def parted(self, frequency: float) -> tuple["FingerVibration", "FingerVibration"]:
        """Return the part of a content's frequency [Hz], and that of all others."""
        is_own = np.abs(self.frequencies - frequency) < SAME_FREQUENCY
        own, others = (
            replace(self, frequencies=self.frequencies[some], amplitudes=self.amplitudes[some])
            for some in (is_own, ~is_own)
        )
        return own, others


@dataclass(frozen=True, kw_only=True)
class TouchRow:
    """A touch from down to up, with its last steady pattern of most contents.

    Its fields are the keys of `era demo --json`, but for the last two. Predicted figures are of the
    table's plate; promised ones, in levels, what nine of ten plates within the uncertainty give.
    Contrasts are None for a finger alone, and measured ones if the pattern was too short.
    """

    time_s: float
    until_s: float
    targets_m: Sequence[Position]
    quiet_m: Sequence[Position]
    """Other fingers, which are to feel nothing of it."""
    reason: str | None = None
    """Why nothing played, if so."""
    drive: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """As the amplifiers achieved it, by ERA."""
    mode: str | None = None
    latency_ms: float | None = None
    """From the touch frame to the last byte on the wire."""
    played_s: float = 0.0
    steady: bool = False
    predicted_contrast_db: float | None = None
    promised_contrast_db: float | None = None
    measured_contrast_db: float | None = None
    predicted_level_db_sl: float | None = None
    measured_level_db_sl: float | None = None
    frequency_hz: float | None = None
    """Of what the finger feels; None for several."""
    verdict: str | None = None
    """Of a finger among several contents, whose contrasts are to those of others there."""
    layers: Sequence[Mapping[str, PlayedTone]] = ()
    """What plays of each content, by ERA, the newest one last."""
    levels_db_sl: Sequence[float | None] = ()
    """Of the target the mean over its tip, then of each quiet finger its loudest point."""

    @property
    def keeps_promise(self) -> bool | None:
        """Whether the steady felt contrast is at least the promised one; None if not measured."""
        promised, measured = self.promised_contrast_db, self.measured_contrast_db
        if not self.steady or promised is None or measured is None:
            return None
        return measured >= promised

    def as_json(self) -> dict[str, Any]:
        """Return the row in the format of `era demo --json`."""
        row = asdict(replace(self, layers=()))
        del row["layers"], row["levels_db_sl"]
        return row


def steady_contrast_db(target: FingerVibration, quiet: Sequence[FingerVibration]) -> float | None:
    """Level of the target above that of the loudest quiet point [dB], steady; None if alone."""
    if not quiet:
        return None
    return target.level_db_sl - max(finger.loudest_db_sl for finger in quiet)


WATCHDOG = 2.0
"""Watchdog [s] of simulated amplifiers, the longest of the protocol: their machine may be busy."""

STARTUP_TIMEOUT = 120.0  # s; solving the plate takes long on a busy machine
EXIT_TIMEOUT = 3.0  # s
_REPLY_TIMEOUT = 30.0  # s; long enough for a busy machine
_MAX_REPLY = 1 << 20  # bytes; what ten fingers feel takes a fiftieth of it
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
        self, control: Path, urls: Mapping[str, str], *, threshold: str = DEFAULT_THRESHOLD
    ) -> None:
        self.urls = urls
        self._control = control
        self._threshold = threshold
        self._placing = asyncio.Lock()  # fingers are placed in order

    async def place_fingers(
        self, positions: Mapping[str, Position], loads: Mapping[str, float] = MappingProxyType({})
    ) -> None:
        """Place fingers at positions [m] by id, loads by id, too; all others are removed."""
        async with self._placing:
            await self._request(bool, "fingers", fingers=dict(positions), loads=dict(loads))

    async def vibration(self, since: float, until: float) -> dict[str, FingerVibration]:
        """Vibration of each finger by id between two times [s] of time.monotonic()."""

        def read(reply: Any) -> dict[str, FingerVibration]:
            return {
                id: FingerVibration(
                    frequencies=np.array(felt["frequencies_hz"], float),
                    amplitudes=np.array(felt["amplitude_m_s2"], float).reshape(
                        len(felt["frequencies_hz"]), len(felt["weights"])
                    ),
                    weights=np.array(felt["weights"], float),
                    threshold=self._threshold,
                )
                for id, felt in reply["fingers"].items()
            }

        return await self._request(read, "felt", since_s=since, until_s=until)

    async def _request(self, read: Callable[[Any], _T], op: str, **values: object) -> _T:
        """Read the reply to a request; raises LinkError if there is none or it is an error."""
        try:
            async with asyncio.timeout(_REPLY_TIMEOUT):
                path = str(self._control)
                reader, writer = await asyncio.open_unix_connection(path, limit=_MAX_REPLY)
                with contextlib.closing(writer):
                    writer.write(json.dumps({"op": op, **values}).encode() + b"\n")
                    reply = json.loads(await reader.readline())
            if "error" in reply:
                raise LinkError(f"simulated plate: {op} refused: {reply['error']}")
            return read(reply)
        except LinkError:
            raise
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            why = str(error) or "it took too long"
            if isinstance(error, KeyError):
                why = f"it has no {error}"
            raise LinkError(
                f"simulated plate at {self._control}: no reply to {op} ({why}); {_REMEDY}"
            ) from error


@contextlib.asynccontextmanager
async def simulated_plate(
    rig_file: Path,
    amplifiers: Collection[str],
    *,
    wire: str,
    seed: int | None = 0,
    threshold: str = DEFAULT_THRESHOLD,
) -> AsyncIterator[SimulatedPlate]:
    """Simulate the amplifiers of a rig file for the duration of the context.

    wire: a key of `SIM_OPTIONS` for a process of their own, "sim" for a plate in this process;
    seed: of the plate within the rig's uncertainty, None for the rig's own; threshold: name of the
    set for levels. Raises LinkError if the process does not start.
    """
    with tempfile.TemporaryDirectory(prefix="era-") as folder:
        path = Path(folder) / "control"
        async with contextlib.AsyncExitStack() as stack:
            if wire == "sim":
                plate = "exact" if seed is None else f"seed={seed}"
                base = f"sim://{quote(os.fsencode(rig_file))}?control={quote(os.fsencode(path))}&{plate}&amplifier="
                urls = {name: base + quote(name) for name in amplifiers}
            else:
                process = await _start(rig_file, wire=wire, control=path, seed=seed)
                stack.push_async_callback(_terminate, process)
                urls = await _read_urls(process, count=len(amplifiers))
            yield SimulatedPlate(path, urls, threshold=threshold)


async def _start(
    rig_file: Path, *, wire: str, control: Path, seed: int | None
) -> asyncio.subprocess.Process:
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


async def _terminate(process: asyncio.subprocess.Process) -> None:
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    await ended(process, EXIT_TIMEOUT)


STEADY_WINDOW = 0.28
"""Time [s] over which a pattern is measured: settled, and it separates tones 10 Hz apart.

It is the end of the longest time in which no finger lands, moves or lifts.
"""

MARGIN = 0.005 + 1 / MAX_RATE
"""Time [s] left out at both ends of it: from wire to plate, and by which an event may be late."""

STEADY_DURATION = 0.4
"""Shortest pattern [s] that counts as steady; the plate rings for 50 ms to 1 s."""

MIN_MOVEMENT = 0.001
"""Movement [m] below which a finger's sensor stays in place, so that its window is not broken."""

_NOT_THE_TARGET = "another finger came down at the same moment and was the target"
_ARMED = DaemonState.OPERATION_ENABLED


@dataclass(eq=False)
class _Pattern:
    """What plays from an event to the next one [s]."""

    event: PatternEvent
    start: float
    ramp: float
    end: float = math.inf
    measured: asyncio.Future[dict[str, FingerVibration]] = field(
        default_factory=lambda: asyncio.get_running_loop().create_future()
    )
    """Vibration of each finger over the longest time in which none moved, known after the end."""

    @property
    def duration(self) -> float:
        return self.end - self.start

    @property
    def targets(self) -> set[str]:
        """The sensors of the fingers that feel it."""
        targets = [each for each in self.event.contacts if each.role == "target"]
        return {_id(each) for each in targets if each.verdict != HELD_BACK}


@dataclass(eq=False)
class _Touch:
    """A touch, and why it feels nothing as long as it does not."""

    contact: ContactStatus
    start: float
    quiet: Sequence[Position]
    reason: str


class TouchRecorder:
    """Collects a row per touch from the events of the daemon: see `follow`.

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
        self.touches: dict[str, _Touch] = {}
        """Those that are down, by the id of their sensor on the plate."""
        self.fault: str | None = None
        """Why the plate is armed no longer; None while it is, and before."""
        self._is_armed = asyncio.Event()
        self._plate = plate
        self._tasks = tasks
        self._on_row = on_row
        self._start = threads.now()
        self._mode: str | None = None
        self._playing: _Pattern | None = None
        self._patterns: list[_Pattern] = []
        self._changes: list[float] = []  # when fingers landed, moved or lifted
        self._sensors: dict[str, Position] = {}
        self._loads: dict[str, float] = {}

    async def follow(self, era: AsyncClient) -> None:
        """Take the events of a daemon until the client is closed."""
        self._mode = (await era.hello("era demo")).table.mode
        await era.subscribe("state", "contacts", "pattern", "silence")
        async for event in era.events():
            self.take(event)

    async def start(self) -> None:
        """Wait until the plate is armed, and set the start of the recording to then."""
        await self._is_armed.wait()
        self._start = threads.now()

    def take(self, event: Notification) -> None:
        """Note an event of one of the topics that `follow` subscribes to."""
        match event.topic:
            case "state":
                self._state_changed(_read(StateEvent, event), event.time)
            case "contacts":
                self._contacts_changed(_read(ContactsEvent, event).contacts, event.time)
            case "pattern":
                self._pattern_changed(_read(PatternEvent, event), event.time)
            case "silence":
                self.end(event.time)
                silence = _read(SilenceEvent, event)
                for contact in silence.contacts:
                    self._give_reason(contact, silence.reason or contact.held_back or "")

    def end(self, now: float, *, is_measured: bool = True) -> None:
        """End the pattern that plays, and measure the end of it."""
        ended, self._playing = self._playing, None
        if ended is None:
            return
        ended.end = now
        settled = ended.start + ended.ramp
        changes = [each for each in self._changes if settled < each < now]
        start, end = max(pairwise([settled, *changes, now]), key=lambda rest: rest[1] - rest[0])
        since, until = max(start, end - STEADY_WINDOW) + MARGIN, end - MARGIN
        self._changes = changes
        if is_measured and since < until:
            self._tasks.create_task(self._measure(ended, since, until))
        else:
            ended.measured.set_result({})

    async def _measure(self, pattern: _Pattern, since: float, until: float) -> None:
        pattern.measured.set_result(await self._plate.vibration(since, until))

    def _state_changed(self, event: StateEvent, now: float) -> None:
        """Note whether the plate is armed; rows of touches that a fault spoils say so."""
        if event.new == _ARMED:
            self.fault = None
            self._is_armed.set()
        elif event.old == _ARMED:
            self.fault = event.cause.partition("; ")[0]  # without its remedy
            self.end(now, is_measured=False)  # silent since a time that is not known
            for touch in self.touches.values():
                touch.reason = self.fault

    def _contacts_changed(self, contacts: Sequence[ContactStatus], now: float) -> None:
        """Make the plate's sensors follow the fingers, and note touches that begin or end."""
        present = {_id(each): each for each in contacts}
        sensors = dict[str, Position]()
        for id, contact in present.items():
            before = self._sensors.get(id, (math.inf, math.inf))
            is_at_rest = math.dist(before, _place(contact)) < MIN_MOVEMENT
            sensors[id] = before if is_at_rest else _place(contact)
            if id not in self.touches:
                others = [_place(each) for each in contacts if each is not contact]
                reason = self.fault or "no vibration was confirmed before it lifted"
                self.touches[id] = _Touch(contact, now, others, reason)
            self.touches[id].contact = contact
        for id in self.touches.keys() - present.keys():
            self._tasks.create_task(self._add_row(self.touches.pop(id), now))
        loads = {id: contact.load for id, contact in present.items()}
        if sensors != self._sensors:
            self._changes.append(now)
        if (sensors, loads) != (self._sensors, self._loads):
            self._sensors, self._loads = sensors, loads
            self._tasks.create_task(self._plate.place_fingers(sensors, loads))

    def _pattern_changed(self, event: PatternEvent, now: float) -> None:
        before = self._playing.event.contacts if self._playing else []
        is_led = [*map(_id, before)] == [*map(_id, event.contacts)]  # cross-faded for same fingers
        self.end(now)
        self._playing = _Pattern(event, now, CROSSFADE if is_led else ONSET_RAMP)
        self._patterns.append(self._playing)
        for contact in event.contacts:
            if contact.role != "target":
                self._give_reason(contact, _NOT_THE_TARGET)
            elif contact.verdict == HELD_BACK:
                self._give_reason(contact, contact.held_back or "")

    def _give_reason(self, contact: ContactStatus, reason: str) -> None:
        """Note why a touch feels nothing, unless a fault is the reason."""
        if _id(contact) in self.touches and self.fault is None:
            self.touches[_id(contact)].reason = reason

    async def _add_row(self, touch: _Touch, until: float) -> None:
        """Make the row of a touch that has been lifted, once nothing plays for it any more."""
        row = TouchRow(
            time_s=touch.start - self._start,
            until_s=until - self._start,
            targets_m=[_place(touch.contact)],
            quiet_m=touch.quiet,
            reason=touch.reason,
        )
        id = _id(touch.contact)
        # Of a pattern and a contact that come at once the pattern may be reported first.
        patterns = [
            each for each in self._patterns if each.end > touch.start and id in each.targets
        ]
        if patterns:
            vibrations = {each: await each.measured for each in patterns}
            played = max(patterns, key=_significance)
            row = _played(row, id, played, vibrations[played])
            row = replace(row, mode=self._mode, latency_ms=patterns[0].event.latency_ms)
        self.rows.append(row)
        self._on_row(row)


def _significance(pattern: _Pattern) -> tuple[int, float, float]:
    """Order of patterns: by contents, then by steadiness, then by time."""
    return len(pattern.event.layers), min(pattern.duration, STEADY_DURATION), pattern.start


def _played(
    row: TouchRow, id: str, pattern: _Pattern, vibration: Mapping[str, FingerVibration]
) -> TouchRow:
    """The row of a finger with a pattern, which is of one moment for all fingers that it serves."""
    event = pattern.event
    felt = next(each for each in event.contacts if _id(each) == id)
    quiet = [each for each in event.contacts if each.role == "quiet"]
    drive = next(  # its own content, or the one that it shares
        (each for each in event.layers.values() if plays_at(each, felt.frequency_hz)), event.drive
    )
    tips = [vibration[_id(each)] for each in (felt, *quiet) if _id(each) in vibration]
    levels: list[float | None] = [None] * (1 + len(quiet))
    level = contrast = None
    if len(tips) == len(levels) and len(tips[0].frequencies):
        own, *others = tips
        levels = [own.level_db_sl, *(each.loudest_db_sl for each in others)]
        if len(event.layers) > 1:
            own, *others = own.parted(felt.frequency_hz or math.nan)
        level, contrast = own.level_db_sl, steady_contrast_db(own, others)
    return replace(
        row,
        reason=None,
        targets_m=[_place(felt)],
        quiet_m=[_place(each) for each in quiet],
        drive={era: tone.model_dump() for era, tone in drive.items()},
        played_s=pattern.duration,
        steady=pattern.duration >= STEADY_DURATION,
        predicted_contrast_db=felt.contrast_db,
        promised_contrast_db=felt.promised_contrast_db,
        predicted_level_db_sl=felt.level_db_sl,
        measured_contrast_db=_finite(contrast),
        measured_level_db_sl=_finite(level),
        frequency_hz=felt.frequency_hz,
        verdict=felt.verdict if len(event.layers) > 1 else None,
        layers=[*event.layers.values()],
        levels_db_sl=levels,
    )


def plays_at(drive: Mapping[str, PlayedTone], frequency: float | None) -> bool:
    """Whether the tones of a content are of a frequency [Hz], which amplifiers may have rounded."""
    return frequency is not None and all(
        abs(tone.frequency_hz - frequency) < SAME_FREQUENCY for tone in drive.values()
    )


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _read(model: type[_MessageT], event: Notification) -> _MessageT:
    return model.model_validate(event.data, extra="ignore")


def _place(contact: ContactStatus) -> Position:
    return contact.x_m, contact.y_m


def _id(contact: ContactStatus) -> str:
    """The id of a contact's sensor on the plate."""
    return f"{contact.source}#{contact.id}"
