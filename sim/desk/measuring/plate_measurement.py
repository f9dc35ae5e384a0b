"""A plate measured through a sound card for its identification: multisines, some of them again."""

import time
from dataclasses import replace

import numpy as np

from model.arrays import FloatArray, best_first
from model.calibration.responses import read_sensors
from model.identification.forward import Sensor
from model.identification.least_squares import (
    DeviceSettings,
    MeasuredPlate,
    Measurement,
    Repeat,
)
from model.processes import Progress
from model.rig.rig import Rig
from sim.desk.measuring.desk import Desk, converters
from sim.desk.measuring.measure import Measured, measure, open_desk, play_run
from sim.desk.measuring.multisine import Multisine
from sim.desk.measuring.sound_card import SoundCard

_REPEATED = 1  # the run: phases differ between ERAs, so that modes of every symmetry vibrate
_COMPARED = 2  # lines of it


def measure_plate(rig: Rig, settings: DeviceSettings, *, progress: Progress) -> MeasuredPlate:
    """Measure through a sound card, which plays and records.

    Raises InputError, LinkError, as `era measure` does.
    """
    desk = Desk(rig, read_sensors(settings.sensors_file, rig.plate))
    with open_desk(
        desk,
        settings.device,
        level=settings.level,
        frequencies=settings.frequencies,
        seed=settings.seed,
    ) as (card, multisine):
        return measure_through(desk, card, multisine, periods=settings.periods, progress=progress)


def measure_through(
    desk: Desk, card: SoundCard, multisine: Multisine, *, periods: int, progress: Progress
) -> MeasuredPlate:
    """All runs; then one of them at half the level, and at the whole one again.

    progress: called with the runs done and all.
    """
    started, runs = time.monotonic(), multisine.sources
    found = measure(
        desk,
        card,
        multisine,
        periods=periods,
        show=lambda recorded: progress(len(recorded), runs + 2),
    )
    repeats = []
    for number, factor in enumerate((0.5, 1.0), start=1):
        again = replace(multisine, level=factor * multisine.level)
        run = play_run(desk, card, again, _REPEATED, periods=periods, before=found.looped)
        repeats.append(_repeats(desk, found, again, run.whole))
        progress(runs + number, runs + 2)
    measurement = replace(
        _measurement(desk, found),
        half_level=repeats[0],
        at_end=repeats[1],
        drives_lag=True,
    )
    return MeasuredPlate(
        measurement,
        multisine.level,
        time.monotonic() - started,
        sensors=tuple(
            {
                "sensor": sensor.name,
                "input": sensor.input,
                "x_m": sensor.x,
                "y_m": sensor.y,
                "coherence_min": found.quality(n)["coherence_min"],
            }
            for n, sensor in enumerate(desk.sensors)
        ),
        notes=(),
        details={"latency_s": found.latency, "repeated_runs": found.repeated},
    )


def _measurement(desk: Desk, found: Measured) -> Measurement:
    """Responses with the usual error of readings and the noise beside it."""
    responses = found.responses
    values = responses.values.swapaxes(1, 2)  # (f, sensors, eras)
    plain = Measurement.of(
        [Sensor(each.name, x=each.x, y=each.y, mass=each.mass) for each in desk.sensors],
        responses.frequencies,
        values,
    )
    rms = np.sqrt((np.abs(values) ** 2).mean(axis=(0, 2)))
    noise = (found.std * rms)[:, :, None] / np.sqrt(2)  # of each part
    return replace(plain, std=np.hypot(plain.std, noise))


def _repeats(
    desk: Desk, found: Measured, multisine: Multisine, recorded: FloatArray
) -> tuple[Repeat, ...]:
    """The loudest lines of a run and what the responses make of them, all ERAs together."""
    full = [*desk.rig.full_levels.values()]
    bases = multisine.played(_REPEATED)[:, : len(full)] * full  # (f, eras)
    first = np.einsum("fes,fe->fs", found.responses.values, bases)
    heard = multisine.found(recorded)[:, desk.columns] / desk.sensitivities
    again = heard / converters(found.looped)[:, None]
    size = np.linalg.norm(bases, axis=1, keepdims=True)
    first, again = first / size, again / size
    names = ", ".join(name for name, _ in desk.eras)
    loudest = best_first(np.linalg.norm(first, axis=1))[:_COMPARED]
    return tuple(
        Repeat(names, float(multisine.frequencies[n]), first[n], again[n]) for n in loudest
    )
