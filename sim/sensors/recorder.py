"""Accelerometers on a bench, and recordings of them and of fingers to a file.

Samples are spooled to an unnamed file in the same folder; the recording is written at the end, so a
killed run leaves nothing behind. A recording stops at its maximum size.
"""

import tempfile
from collections import deque
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from model.answer.stimulus import check_on_plate
from model.arrays import FloatArray
from model.errors import InputError
from sim.bench.bench import Bench
from sim.plant.accelerometer import Accelerometer, positions, readings
from sim.plant.fingers import KEPT
from sim.sensors.recording import Recording, check_recordable, max_values, write_recording

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
        while self._pieces[0][0][-1] < times[-1] - KEPT:
            self._pieces.popleft()

    def read(self, since: float, until: float) -> Recording:
        """Readings in since <= t < until [s]; InputError where there are none."""
        pieces = [piece for piece in self._pieces if piece[0][-1] >= since and piece[0][0] < until]
        if not pieces:
            raise InputError(
                f"no readings from {since:g} to {until:g} s; place sensors first, and ask for the "
                f"last {KEPT:g} s at most"
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
