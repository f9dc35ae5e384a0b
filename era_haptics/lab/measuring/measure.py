"""Responses of a rig's plate: measured through a sound card by multisines, or simulated.

For identification one run is repeated at half the level and at the whole one. A simulated plate
deviates from its rig's file.
"""

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from controller.plate_measurement import MeasuredPlate
from era_haptics.lab.measuring.loopback import (
    check_clocks,
    check_coherence,
    check_levels,
    check_wiring,
    is_as_late,
    is_whole,
    latency,
    written,
)
from era_haptics.lab.measuring.sound_card import (
    PERIOD,
    TRIES,
    Desk,
    Multisine,
    Run,
    SoundCard,
    are_positions,
    converters,
    default_frequencies,
    estimate,
    open_card,
    play,
    read_sensors,
    run_time,
)
from model.arrays import ComplexArray, FloatArray, best_first
from model.commands.options import Stopwatch, progress_bar
from model.estimate.measurement import Measurement, Repeat, write_responses
from model.processes import Progress, unseen
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from model.structure.attachments import PointLoad
from sim.plant.imperfections import draw_imperfections


def loopback_gain(
    desk: Desk, multisine: Multisine, number: int, recorded: FloatArray
) -> ComplexArray:
    """Complex gain (f,) of the cable in whole periods of a run (n, inputs)."""
    amplitudes = multisine.played(number)[:, desk.looped]
    return np.asarray(multisine.found(recorded[:, desk.input - 1]) / amplitudes)


def play_run(
    desk: Desk,
    card: SoundCard,
    multisine: Multisine,
    number: int,
    *,
    periods: int,
    before: ComplexArray | None,
    tries: int = TRIES,
) -> Run:
    """Play a run, again where blocks were lost in it or since the first one; keep whole periods.

    before (f,): the loop-back's gain in the first run, None in that. Raises InputError, LinkError
    for inputs that are clipped or silent.
    """

    def is_same(kept: FloatArray) -> bool:
        """By the cable: drivers report losses that were none, and miss others."""
        check_levels(kept, desk.named_inputs)
        return is_whole(kept[:, desk.input - 1], samples=multisine.samples) and (
            before is None or is_as_late(loopback_gain(desk, multisine, number, kept), before)
        )

    seconds = run_time(periods, settling=desk.settling)
    signal = desk.on_outputs(multisine.signal(number, periods=seconds / PERIOD))
    return play(
        card,
        signal,
        settling=desk.settling,
        seconds=PERIOD * periods,
        is_whole=is_same,
        tries=tries,
    )


LEVEL = 0.3
"""Usual largest sample of each output."""


@dataclass(frozen=True, eq=False)
class MeasuredResponses:
    """Responses with what is known of them.

    coherence (f, sensors), std (f, sensors) relative to the root mean square of the sensor; latency
    [s] through the sound card; even (sensors,): of a square law; repeated: runs played again since
    blocks were lost; looped (f,): response of the loop-back.
    """

    responses: Measurement
    coherence: FloatArray
    std: FloatArray
    latency: float
    even: FloatArray
    repeated: int
    looped: ComplexArray

    def quality(self, sensor: int) -> dict[str, float]:
        """How well a sensor was heard, by its number, for programs."""
        return {
            "coherence_median": float(np.median(self.coherence[:, sensor])),
            "coherence_min": float(self.coherence[:, sensor].min()),
            "noise_relative": float(np.median(self.std[:, sensor])),
            "square_law_relative": float(self.even[sensor]),
        }


@contextmanager
def open_desk(
    desk: Desk,
    device: str,
    *,
    level: float | None,
    frequencies: FloatArray | None,
    seed: int,
) -> Iterator[tuple[SoundCard, Multisine]]:
    """An open device for a desk, and the multisine for it.

    level: None for 0.3, or less where the rig's limits allow less; frequencies (f,) [Hz], None for
    odd ones within its limits. Raises InputError, LinkError.
    """
    level = min(LEVEL, desk.highest) if level is None else level
    desk.check(level)
    if frequencies is None:
        limits = desk.rig.limits
        frequencies = default_frequencies(limits.frequency_min, limits.frequency_max)
    desk.check_frequencies(frequencies, what="--frequencies")
    with closing(open_card(device, outputs=desk.output, inputs=desk.input, limit=level)) as card:
        yield card, Multisine(frequencies, len(desk.sources), card.rate, level, seed)


def measure(
    desk: Desk,
    card: SoundCard,
    multisine: Multisine,
    *,
    periods: int = 2,
    progress: Progress = unseen,
    is_heard: bool = False,
) -> MeasuredResponses:
    """Play all runs of a multisine and estimate the responses.

    periods: of each run that are analysed. progress: called with the runs done and all. is_heard:
    whether every ERA was heard before, at another place of a sensor that is moved. Raises
    InputError, LinkError for what is clipped, silent, swapped, incoherent, or lost three times.
    """
    seconds = run_time(periods, settling=desk.settling)
    desk.check_times(seconds=seconds, slew=multisine.slew)
    runs: list[Run] = []
    recorded: list[FloatArray] = []
    for number in range(multisine.sources):
        before = loopback_gain(desk, multisine, 0, recorded[0]) if recorded else None
        tries = TRIES if all(run.is_whole for run in runs) else 1
        runs.append(
            play_run(desk, card, multisine, number, periods=periods, before=before, tries=tries)
        )
        recorded.append(runs[-1].recorded)
        progress(len(recorded), multisine.sources)
    found = estimate(multisine, recorded)
    # Another signal than the loop-back's, or another clock, looks like lost blocks; that is the
    # cause to be told.
    check_wiring(found, desk)
    check_clocks(multisine, recorded, desk)
    whole = [run.whole for run in runs]
    check_coherence(found, whole, desk, is_heard=is_heard)
    looped, columns = found.values[:, desk.input - 1, desk.looped], desk.columns
    of_eras = found.values[:, columns, : len(desk.eras)]
    rms = np.sqrt((np.abs(of_eras) ** 2).mean(axis=(0, 2)))
    return MeasuredResponses(
        desk.responses(multisine.frequencies, found.values, looped),
        found.coherence[:, columns],
        found.std[:, columns] / rms,
        latency(looped, multisine.frequencies),
        found.even[columns],
        sum(run.repeated for run in runs),
        looped,
    )


def measure_at_once(
    desk: Desk,
    opened: AbstractContextManager[tuple[SoundCard, Multisine]],
    output: Path,
    *,
    periods: int,
) -> tuple[list[str], dict[str, Any]]:
    """Measure, write the responses, and return the report.

    Raises InputError, LinkError, OSError.
    """
    with Stopwatch() as timed, opened as (card, multisine), progress_bar("runs") as progress:
        found = measure(desk, card, multisine, periods=periods, progress=progress)
    write_responses(output, found.responses, desk.rig)
    written = f"measured in {timed.elapsed:.1f} s; wrote {output}"
    return [*_rows(found, rate=card.rate), written], {
        "frequencies_hz": found.responses.frequencies.tolist(),
        "latency_s": found.latency,
        "repeated_runs": found.repeated,
        "sensors": {name: found.quality(n) for n, name in enumerate(found.responses.names)},
        "measure_time_s": timed.elapsed,
        "files": [str(output)],
    }


def _rows(found: MeasuredResponses, *, rate: float) -> Iterator[str]:
    """Yield how well responses were measured."""
    lines = found.responses.frequencies
    yield (
        f"{len(lines)} frequencies from {lines[0]:g} to {lines[-1]:g} Hz; delay of the sound card "
        f"{1e3 * found.latency:.3f} ms ({found.latency * rate:.1f} samples); "
        f"{found.repeated} runs repeated for lost blocks"
    )
    yield "sensor      coherence   lowest   noise    square law"
    for n, name in enumerate(found.responses.names):
        yield (
            f"{name:10s} {np.median(found.coherence[:, n]):10.4f} "
            f"{found.coherence[:, n].min():8.4f} {100 * np.median(found.std[:, n]):6.2f} % "
            f"{100 * found.even[n]:8.2f} %"
        )


_REPEATED = 1  # the run: phases differ between ERAs, so that modes of every symmetry vibrate
_COMPARED = 2  # lines of it


def measure_plate(
    rig: Rig,
    device: str,
    sensors_file: Path,
    *,
    level: float | None,
    frequencies: FloatArray | None,
    periods: int,
    seed: int,
    progress: Progress,
) -> MeasuredPlate:
    """Measure through a sound card, which plays and records.

    level, frequencies, seed: as of `open_desk`; periods: of each run that count. Raises InputError,
    LinkError, as `era measure` does.
    """
    desk = Desk(rig, read_sensors(sensors_file, rig.plate))
    with open_desk(desk, device, level=level, frequencies=frequencies, seed=seed) as opened:
        return measure_through(desk, *opened, periods=periods, progress=progress)


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
        progress=lambda done, _all: progress(done, runs + 2),
    )
    repeats = []
    for number, factor in enumerate((0.5, 1.0), start=1):
        again = replace(multisine, level=factor * multisine.level)
        run = play_run(desk, card, again, _REPEATED, periods=periods, before=found.looped)
        repeats.append(_repeats(desk, found, again, run.whole))
        progress(runs + number, runs + 2)
    # Responses with the usual error of readings, and the noise beside it.
    plain = found.responses
    rms = np.sqrt((np.abs(plain.values) ** 2).mean(axis=(0, 2)))
    noise = (found.std * rms)[:, :, None] / np.sqrt(2)  # of each part
    measurement = replace(
        plain, errors=np.hypot(plain.std, noise), half_level=repeats[0], at_end=repeats[1]
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


def _repeats(
    desk: Desk, found: MeasuredResponses, multisine: Multisine, recorded: FloatArray
) -> tuple[Repeat, ...]:
    """The loudest lines of a run and what the responses make of them, all ERAs together."""
    full = [*desk.rig.full_levels.values()]
    bases = multisine.played(_REPEATED)[:, : len(full)] * full  # (f, eras)
    first = np.einsum("fse,fe->fs", found.responses.values, bases)
    heard = multisine.found(recorded)[:, desk.columns] / desk.sensitivities
    again = heard / converters(found.looped)[:, None]
    size = np.linalg.norm(bases, axis=1, keepdims=True)
    first, again = first / size, again / size
    names = ", ".join(name for name, _ in desk.eras)
    loudest = best_first(np.linalg.norm(first, axis=1))[:_COMPARED]
    return tuple(
        Repeat(names, float(multisine.frequencies[n]), first[n], again[n]) for n in loudest
    )


NOISE = 2e-3
"""Of a sensor's root mean square over all that it reads, of each part."""


def measured_by_simulation(
    desk: Desk, output: Path, *, frequencies: FloatArray | None, seed: int
) -> tuple[list[str | None], dict[str, Any]]:
    """Write responses of a plate drawn within a rig's uncertainty; return the report.

    frequencies (f,) [Hz]: None for those of `era measure`; seed: of the plate and of the noise.
    Sensors weigh what their file says, one that is moved at one place at a time. Raises InputError
    for frequencies beyond the rig's limits.
    """
    rig, sensors = desk.rig, desk.sensors
    limits, drawn = rig.limits, draw_imperfections(rig, seed=seed)
    if frequencies is None:
        frequencies = default_frequencies(limits.frequency_min, limits.frequency_max)
    desk.check_frequencies(frequencies, what="--frequencies")
    real = drawn.plate.realised(rig)
    plate = solve_free_plate(real.plate, real.mesh, frequency_max=limits.frequency_max)
    points = np.array([[each.x, each.y] for each in sensors])
    weights = [PointLoad(each.x, each.y, mass=each.mass) for each in sensors]
    found = [
        plate.acceleration(
            real.eras,
            frequencies,
            point[None],
            loads=[*real.masses, *([weight] if are_positions(sensors) else weights)],
        )
        for point, weight in zip(points, weights, strict=True)
    ]
    drives = drawn.factors(rig) / np.array([*rig.full_levels.values()])
    values = np.concatenate(found, axis=2) * drives[:, None]  # (f, eras, sensors)
    parts = np.random.default_rng(seed).standard_normal((2, *values.shape))
    rms = np.sqrt((np.abs(values) ** 2).mean(axis=(0, 1)))
    values += NOISE * rms * (parts[0] + 1j * parts[1])
    places = [each.place for each in sensors]
    if not are_positions(sensors):
        places = [replace(each, mass=0.0) for each in places]
    measured = Measurement(places, frequencies, values.swapaxes(1, 2))
    return written(measured, desk, output, source="simulated plate")
