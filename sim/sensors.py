"""Accelerometers on a bench, and recordings of them and of fingers: CSV, WAV, universal files.

The suffix selects the format: WAV is for audio tools, universal files are for modal software.
Samples are spooled to an unnamed file in the same folder and written at the end, replacing a file
atomically, so that a killed run leaves nothing behind. A recording stops at its maximum size.
"""

import csv
import json
import math
import tempfile
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from model.answer.stimulus import check_on_plate
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.files.output_paths import begins_with
from model.files.uff import (
    ACCELERATION,
    TIME_RESPONSE,
    UFF_TIME,
    Function,
    Universal,
    write_universal,
)
from registry.files import regular_file
from sim.bench.bench import Bench
from sim.plant.fingers import HISTORY_DURATION, Accelerometer, fit_tones, positions, readings


@dataclass(frozen=True, eq=False)
class Recording:
    """Readings [m/s²] of sensors, samples (n, s), the first at start [s].

    names, points (s, 2) [m]: of the sensors; sample_rate [Hz].
    """

    names: tuple[str, ...]
    points: FloatArray
    sample_rate: float
    start: float
    samples: FloatArray

    @property
    def times(self) -> FloatArray:
        """Time of each sample [s], (n,)."""
        return np.asarray(self.start + np.arange(len(self.samples)) / self.sample_rate)

    def during(self, since: float, until: float) -> "Recording":
        """The part with since <= t < until [s]."""
        inside = np.flatnonzero((self.times >= since) & (self.times < until))
        if len(inside) == 0:
            raise InputError(f"no samples from {since:g} to {until:g} s")
        return Recording(
            self.names,
            self.points,
            self.sample_rate,
            float(self.times[inside[0]]),
            self.samples[inside],
        )

    def tones(self, frequencies: Sequence[float]) -> ComplexArray:
        """Complex amplitude (f, s) [m/s²] of tones, Im[a exp(i omega t)], t on the plate's clock.

        Least squares of all tones and a constant; it must be longer than the inverse of the
        smallest frequency difference. Raises InputError for fewer samples than unknowns.
        """
        needed = 2 * len(frequencies) + 1
        if len(self.samples) < needed:
            raise InputError(
                f"{len(frequencies)} tones need {needed} samples, got {len(self.samples)}: record "
                "longer"
            )
        return fit_tones(self.times, self.samples, frequencies, with_offset=True)


_CHUNK = 10_000  # samples; written at once
_UP = 3
_MAX_NAME = 10


@dataclass(frozen=True)
class RecordingFormat:
    """A file format.

    start: the first bytes of a file; max_values: limit that bounds memory; cannot_hold: why
    recordings of these names at this sampling rate [Hz] do not fit, None where they do; sidecars:
    the files beside one.
    """

    write: Callable[[Path, Recording], None]
    start: bytes
    max_values: int
    cannot_hold: Callable[[Sequence[str], float], str | None] = lambda names, sample_rate: None
    sidecars: Callable[[Path], tuple[Path, ...]] = lambda path: ()


def _write_csv(path: Path, recording: Recording) -> None:
    """Header `time_s`, `P1_m_s2`, ..., positions `x_m` and `y_m`, then samples."""
    with open(path, "w", newline="", encoding="utf-8", opener=regular_file) as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["time_s", *(f"{name}_m_s2" for name in recording.names)])
        for label, positions in zip(("x_m", "y_m"), recording.points.T.tolist(), strict=True):
            writer.writerow([label, *positions])
        times = recording.times
        for first in range(0, len(times), _CHUNK):
            part = slice(first, first + _CHUNK)
            writer.writerows(np.column_stack([times[part], recording.samples[part]]).tolist())


def sidecar(path: Path) -> Path:
    """The sidecar of a WAV."""
    return path.with_name(path.name + ".json")


def _write_wav(path: Path, recording: Recording) -> None:
    """A channel per sensor, 32-bit float between -1 and 1: exact to 6e-8 of the largest value.

    Full scale [m/s²], positions and start are in a sidecar `NAME.wav.json`, since audio tools drop
    unknown metadata.
    """
    from scipy.io import wavfile

    # A power of two, so that no digits are lost.
    largest = float(max(recording.samples.max(), -recording.samples.min()))
    full_scale = 2.0 ** math.ceil(math.log2(largest)) if largest > 0 else 1.0
    samples = (recording.samples / full_scale).astype(np.float32)
    wavfile.write(path, int(recording.sample_rate), samples)
    x, y = recording.points.T.tolist()
    metadata = {
        "format": "era-haptics recording 1",
        "sensors": recording.names,
        "x_m": x,
        "y_m": y,
        "start_s": recording.start,
        "sample_rate_hz": recording.sample_rate,
        "full_scale_m_s2": full_scale,
    }
    sidecar(path).write_text(json.dumps(metadata, indent=1) + "\n", encoding="utf-8")


def _whole_rate(names: Sequence[str], sample_rate: float) -> str | None:
    if sample_rate == round(sample_rate):
        return None
    return f"sampling rate must be whole in WAV, got {sample_rate:g} Hz; write .csv or .uff"


def _write_uff(path: Path, recording: Recording) -> None:
    """A dataset 58 per sensor with 12 digits; start and sampling interval have six."""
    nodes = {n: (x, y, 0.0) for n, (x, y) in enumerate(recording.points.tolist(), start=1)}
    functions = [
        Function(
            str(path),
            TIME_RESPONSE,
            number,
            0,
            (name, ""),
            (_UP, 0),
            recording.times,
            recording.samples[:, number - 1],
            (UFF_TIME, ACCELERATION, 0),
            ("m/s^2", ""),
        )
        for number, name in enumerate(recording.names, start=1)
    ]
    write_universal(path, Universal(nodes, functions))


def _short_names(names: Sequence[str], sample_rate: float) -> str | None:
    long = [name for name in names if len(name) > _MAX_NAME]
    return f"names must have at most {_MAX_NAME} characters, got {long[0]!r}" if long else None


_UFF = RecordingFormat(
    _write_uff, b"    -1", 1 << 22, _short_names
)  # as text in memory, 20 bytes a value

FORMATS = {
    ".csv": RecordingFormat(_write_csv, b"time_s", 1 << 24),
    ".wav": RecordingFormat(
        _write_wav, b"RIFF", 1 << 24, _whole_rate, lambda path: (sidecar(path),)
    ),
    ".uff": _UFF,
    ".unv": _UFF,
}
"""By suffix."""


def write_recording(path: Path, recording: Recording) -> None:
    """Write a recording in the format of the suffix: .csv, .wav, .uff or .unv.

    Raises InputError for another suffix or what the format cannot hold, OSError.
    """
    if not len(recording.samples) > 1:
        raise InputError(f"{path}: a recording must have at least two samples")
    if not np.isfinite(recording.samples).all():
        raise InputError(f"{path}: samples must be finite")
    check_recordable(path, recording.names, sample_rate=recording.sample_rate)
    kind = _format_of(path)
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    # The main file last: where it exists, its sidecar does.
    parts = dict(zip((*kind.sidecars(part), part), (*kind.sidecars(path), path), strict=True))
    try:
        kind.write(part, recording)
        for made, wanted in parts.items():
            made.replace(wanted)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error
    finally:
        for made in parts:
            made.unlink(missing_ok=True)


def check_recordable(path: Path, names: Sequence[str], *, sample_rate: float) -> None:
    """Raise InputError for a recording that the format cannot hold, or an unrelated file there."""
    kind = _format_of(path)
    if path.is_file() and not begins_with(path, kind.start):
        raise InputError(
            f"{path}: exists and is not a recording; give another name, or remove it first"
        )
    why_not = kind.cannot_hold(names, sample_rate)
    if why_not is not None:
        raise InputError(f"{path}: {why_not}")


def max_values(path: Path) -> int:
    """Maximum number of values of a recording in this file."""
    return _format_of(path).max_values


def _format_of(path: Path) -> RecordingFormat:
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: suffix must be one of {', '.join(FORMATS)}")
    return FORMATS[path.suffix.lower()]


MAX_SENSORS = 64  # ten seconds of readings take 50 MB


class Accelerometers:
    """The sensors on a bench, at first none."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._rng = np.random.default_rng(0)
        self._pieces: deque[tuple[FloatArray, FloatArray]] = deque()  # times, readings
        self.sensors: tuple[Accelerometer, ...] = ()

    @property
    def shapes(self) -> FloatArray:
        """Shapes at the sensors, in the present coordinates of the plate."""
        return self._bench.shapes_at(positions(self.sensors))

    def place(self, sensors: Sequence[Accelerometer]) -> None:
        """Replace the sensors; InputError changes nothing."""
        if len(sensors) > MAX_SENSORS:
            raise InputError(f"number of sensors must be at most {MAX_SENSORS}, got {len(sensors)}")
        names = [sensor.name for sensor in sensors]
        if len(set(names)) < len(names):
            raise InputError(f"names of sensors must be unique, got {', '.join(names)}")
        for sensor in sensors:
            check_on_plate(f"sensor {sensor.name}", [(sensor.x, sensor.y)], self._bench.rig.plate)
        self.sensors = tuple(sensors)
        self._bench.place_sensors(sensors)
        self._pieces.clear()
        if self in self._bench.probes:
            self._bench.probes.remove(self)
        if sensors:
            self._bench.probes.append(self)

    def record(self, times: FloatArray, accelerations: FloatArray) -> None:
        """Read accelerations: times (n,) [s], (n, s) [m/s²]."""
        rate = self._bench.sample_rate
        read = readings(self.sensors, accelerations, sample_rate=rate, rng=self._rng)
        self._pieces.append((times, read))
        while self._pieces[0][0][-1] < times[-1] - HISTORY_DURATION:
            self._pieces.popleft()

    def read(self, since: float, until: float) -> Recording:
        """Readings in since <= t < until [s]; InputError where there are none."""
        pieces = [piece for piece in self._pieces if piece[0][-1] >= since and piece[0][0] < until]
        if not pieces:
            raise InputError(
                f"no readings from {since:g} to {until:g} s; place sensors first, and ask for the "
                f"last {HISTORY_DURATION:g} s at most"
            )
        return Recording(
            tuple(sensor.name for sensor in self.sensors),
            positions(self.sensors),
            self._bench.sample_rate,
            float(pieces[0][0][0]),
            np.concatenate([read for _, read in pieces]),
        ).during(since, until)


class Recorder:
    """Records a bench to a file in the format of its suffix.

    sensors: readings, noise included; fingers: ids, the acceleration at the centre of each, zero
    while it is off the plate. Raises InputError for a path that cannot be written, or nothing to
    record.
    """

    def __init__(
        self,
        bench: Bench,
        path: Path,
        *,
        sensors: Sequence[Accelerometer],
        fingers: Sequence[str],
    ) -> None:
        self.path = path
        self._bench = bench
        self._sensors = tuple(sensors)
        self._fingers = tuple(fingers)
        names = [*(sensor.name for sensor in sensors), *(f"finger_{id}" for id in fingers)]
        if not names:
            raise InputError(f"{path}: nothing to record; add --sensor NAME=X,Y or --finger X,Y")
        check_recordable(path, names, sample_rate=bench.sample_rate)
        self._names = tuple(names)
        self._room = max_values(path) // len(names)
        at = [bench.fingers.layout.positions[id] for id in fingers]
        self._points = np.concatenate([positions(sensors), np.array(at).reshape(-1, 2)])
        self._rng = np.random.default_rng(0)
        try:
            # Unbuffered, so that a full disk fails the write itself.
            self._spool = tempfile.TemporaryFile(dir=path.parent, buffering=0)  # noqa: SIM115
        except OSError as error:
            raise InputError(
                f"{path}: cannot be written: {error.strerror}; choose another folder"
            ) from error
        self._start = 0.0
        self._count = 0
        self._failure: OSError | None = None
        bench.probes.append(self)

    @property
    def is_full(self) -> bool:
        """Whether it has reached its maximum size."""
        return self._count >= self._room

    @property
    def seconds(self) -> float:
        """Its duration [s]."""
        return self._count / self._bench.sample_rate

    @property
    def shapes(self) -> FloatArray:
        """Shapes at sensors and fingers, which may move."""
        layout = self._bench.fingers.layout
        at_sensors = self._bench.shapes_at(positions(self._sensors))
        rows = [
            layout.shapes[layout.columns[id].start]
            if id in layout.columns
            else np.zeros(at_sensors.shape[1])
            for id in self._fingers
        ]
        return np.vstack([at_sensors, *rows])

    def record(self, times: FloatArray, accelerations: FloatArray) -> None:
        """Spool readings: times (n,) [s], accelerations (n, p) [m/s²]."""
        if self._failure is not None:
            return
        if not self._count:
            self._start = float(times[0])
        accelerations = accelerations[: self._room - self._count]
        of_sensors, of_fingers = np.split(accelerations, [len(self._sensors)], axis=1)
        rate = self._bench.sample_rate
        read = readings(self._sensors, of_sensors, sample_rate=rate, rng=self._rng)
        together = np.hstack([read, of_fingers])
        left = memoryview(np.ascontiguousarray(together, dtype=np.float64).tobytes())
        try:
            while left:
                left = left[self._spool.write(left) :]
        except OSError as error:  # a full disk must not end the simulation
            self._failure = error
        else:
            self._count += len(accelerations)

    def stop(self) -> None:
        """Stop recording, in the thread of the bench."""
        if self in self._bench.probes:
            self._bench.probes.remove(self)

    def finish(self) -> None:
        """Write the file and discard the spool, in any thread, after `stop`.

        Raises InputError for fewer than two samples, OSError.
        """
        with self._spool:
            if self._failure is not None:
                raise InputError(
                    f"{self.path}: recording failed after {self.seconds:g} s and is not written: "
                    f"{self._failure.strerror}; free disk space"
                )
            shape = (self._count, len(self._names))
            samples = (
                np.memmap(self._spool, np.float64, "r", shape=shape)
                if self._count
                else np.zeros(shape)
            )
            write_recording(
                self.path,
                Recording(self._names, self._points, self._bench.sample_rate, self._start, samples),
            )
