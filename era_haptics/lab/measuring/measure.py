"""Measure a plate through a sound card.

A measurement consists of several runs of a multisine, from which responses are estimated and
checked. For identification, one run is repeated at half level and at full level.
"""

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from era_haptics.lab.measuring.clock_drift import check_clocks
from era_haptics.lab.measuring.desk import Desk, converter_response
from era_haptics.lab.measuring.loopback import (
    check_wiring,
    has_all_blocks,
    latency,
    loopback_gain,
)
from era_haptics.lab.measuring.multisine import PERIOD, Multisine, estimate, multisine_frequencies
from era_haptics.lab.measuring.recording_checks import check_coherence, check_levels
from era_haptics.lab.measuring.runs import TRIES, Run, play_and_record, run_time
from era_haptics.lab.measuring.sensor_file import WiredSensor, read_sensors
from era_haptics.lab.measuring.sound_card import SoundCard, open_card
from model.arrays import ComplexArray, FloatArray, best_first
from model.commands.options import Stopwatch, progress_bar
from model.estimate.measurement import MeasuredPlate, Measurement, Repeat
from model.processes import Progress, unseen
from model.response_files import write_responses
from model.rig.rig import Rig

_LEVEL = 0.3  # usual largest sample of each output
_MAX_CHANGE = 0.02  # of the loop-back's gain; one sample more at 500 Hz and 48 kHz makes 0.065
_REPEATED_RUN = 1  # phases differ between ERAs, so that modes of every symmetry vibrate
_COMPARED_LINES = 2  # of the repeated run


@dataclass(frozen=True, eq=False)
class MeasuredResponses:
    """Responses with their uncertainty and quality.

    - coherence (f, sensors).
    - std (f, sensors): relative to the RMS of the sensor's responses.
    - latency [s]: through the sound card.
    - even (sensors,): even harmonics, which indicate a square law.
    - repeated: number of runs repeated because of lost blocks.
    - loopback (f,): response of the loop-back.
    """

    responses: Measurement
    coherence: FloatArray
    std: FloatArray
    latency: float
    even: FloatArray
    repeated: int
    loopback: ComplexArray

    def quality(self, sensor: int) -> dict[str, float]:
        """Return quality figures of the sensor with a given number, for JSON."""
        coherence = self.coherence[:, sensor]
        std = self.std[:, sensor]
        return {
            "coherence_median": float(np.median(coherence)),
            "coherence_min": float(coherence.min()),
            "noise_relative": float(np.median(std)),
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
    """Open a device for a desk; yield it with its multisine.

    level: None for 0.3, or less if the rig's limits require it; frequencies (f,) [Hz]: None for odd
    ones within the limits. Raises InputError, LinkError.
    """
    if level is None:
        level = min(_LEVEL, desk.max_level)
    desk.check_level(level)
    if frequencies is None:
        limits = desk.rig.limits
        frequencies = multisine_frequencies(limits.frequency_min, limits.frequency_max)
    desk.check_frequencies(frequencies, what="--frequencies")
    wiring = desk.wiring
    source_count = len(wiring.source_outputs)
    outputs, inputs = wiring.loopback_output, wiring.loopback_input
    with closing(open_card(device, outputs=outputs, inputs=inputs, limit=level)) as card:
        yield card, Multisine(frequencies, source_count, card.rate, level, seed)


def play_run(
    desk: Desk,
    card: SoundCard,
    multisine: Multisine,
    number: int,
    *,
    periods: int,
    first_gain: ComplexArray | None,
    tries: int = TRIES,
) -> Run:
    """Play a run and keep whole periods; repeat it if blocks were lost since the first run.

    first_gain (f,): the loop-back's gain in the first run; None in the first run itself. Raises
    InputError, LinkError for inputs that are clipped or silent.
    """
    wiring = desk.wiring

    def is_whole(recorded: FloatArray) -> bool:
        """Compare the loop-back, since drivers report false losses and miss real ones."""
        check_levels(recorded, wiring.input_names)
        if first_gain is not None:  # a block that was lost between two runs changes the delay
            gain = loopback_gain(wiring, multisine, number, recorded)
            change = np.abs(gain - first_gain).max()
            if change > _MAX_CHANGE * np.abs(first_gain).max():
                return False
        loopback = recorded[:, wiring.loopback_input - 1]
        return has_all_blocks(loopback, samples=multisine.samples)

    seconds = run_time(periods, settling=desk.settling)
    signal = wiring.on_outputs(multisine.signal(number, periods=seconds / PERIOD))
    return play_and_record(
        card,
        signal,
        settling=desk.settling,
        seconds=PERIOD * periods,
        is_whole=is_whole,
        tries=tries,
    )


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

    periods: analyzed periods per run. progress: called with the number of runs done and the total.
    is_heard: whether every ERA was detected before, at another position of a moved sensor. Raises
    InputError or LinkError for inputs that are clipped, silent, swapped or incoherent, and for
    blocks lost three times in a row.
    """
    seconds = run_time(periods, settling=desk.settling)
    desk.check_times(seconds=seconds, slew=multisine.slew)
    runs = _play_runs(desk, card, multisine, periods=periods, progress=progress)
    recorded = [run.recorded for run in runs]
    estimated = estimate(multisine, recorded)
    # A wrong loop-back signal, or another clock, looks like lost blocks; report the cause instead.
    wiring = desk.wiring
    check_wiring(estimated, wiring)
    check_clocks(multisine, recorded, wiring)
    whole_runs = [run.whole for run in runs]
    check_coherence(estimated, whole_runs, wiring, is_heard=is_heard)
    columns = wiring.sensor_columns
    loopback = wiring.loopback_of(estimated.values)
    era_responses = wiring.era_responses_of(estimated.values)
    return MeasuredResponses(
        responses=desk.responses(multisine.frequencies, era_responses, loopback),
        coherence=estimated.coherence[:, columns],
        std=estimated.std[:, columns] / _rms_by_sensor(era_responses),
        latency=latency(loopback, multisine.frequencies),
        even=estimated.even[columns],
        repeated=sum(run.repeated for run in runs),
        loopback=loopback,
    )


def _rms_by_sensor(values: ComplexArray) -> FloatArray:
    """RMS over frequencies and ERAs of responses (f, sensors, ERAs), (sensors,)."""
    power = np.abs(values) ** 2
    return np.asarray(np.sqrt(power.mean(axis=(0, 2))))


def _play_runs(
    desk: Desk, card: SoundCard, multisine: Multisine, *, periods: int, progress: Progress
) -> list[Run]:
    """Play all runs; after an incomplete run, no run is repeated."""
    runs: list[Run] = []
    first_gain: ComplexArray | None = None
    for number in range(multisine.sources):
        tries = TRIES if all(run.is_whole for run in runs) else 1
        run = play_run(
            desk, card, multisine, number, periods=periods, first_gain=first_gain, tries=tries
        )
        runs.append(run)
        if first_gain is None:
            first_gain = loopback_gain(desk.wiring, multisine, 0, run.recorded)
        progress(len(runs), multisine.sources)
    return runs


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
    with Stopwatch() as stopwatch, opened as (card, multisine), progress_bar("runs") as progress:
        measured = measure(desk, card, multisine, periods=periods, progress=progress)
    responses = measured.responses
    write_responses(output, responses, desk.rig)
    lines = [*_quality_lines(measured, rate=card.rate)]
    lines.append(f"measured in {stopwatch.elapsed:.1f} s; wrote {output}")
    qualities = {}
    for number, name in enumerate(responses.names):
        qualities[name] = measured.quality(number)
    return lines, {
        "frequencies_hz": responses.frequencies.tolist(),
        "latency_s": measured.latency,
        "repeated_runs": measured.repeated,
        "sensors": qualities,
        "measure_time_s": stopwatch.elapsed,
        "files": [str(output)],
    }


def _quality_lines(measured: MeasuredResponses, *, rate: float) -> Iterator[str]:
    """Yield lines with the quality of responses."""
    frequencies = measured.responses.frequencies
    delay = f"{1e3 * measured.latency:.3f} ms ({measured.latency * rate:.1f} samples)"
    yield (
        f"{len(frequencies)} frequencies from {frequencies[0]:g} to {frequencies[-1]:g} Hz; delay "
        f"of the sound card {delay}; {measured.repeated} runs repeated for lost blocks"
    )
    yield "sensor      coherence   lowest   noise    square law"
    for number, name in enumerate(measured.responses.names):
        quality = measured.quality(number)
        yield (
            f"{name:10s} {quality['coherence_median']:10.4f} "
            f"{quality['coherence_min']:8.4f} {100 * quality['noise_relative']:6.2f} % "
            f"{100 * quality['square_law_relative']:8.2f} %"
        )


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

    level, frequencies, seed: see `open_desk`; periods: analyzed periods per run. Raises InputError,
    LinkError, like `era measure`.
    """
    desk = Desk(rig, read_sensors(sensors_file, rig.plate))
    with open_desk(desk, device, level=level, frequencies=frequencies, seed=seed) as opened:
        return measure_through(desk, *opened, periods=periods, progress=progress)


def measure_through(
    desk: Desk, card: SoundCard, multisine: Multisine, *, periods: int, progress: Progress
) -> MeasuredPlate:
    """Measure all runs, then repeat one run at half level and at full level.

    progress: called with the number of runs done and the total.
    """
    started_at = time.monotonic()
    total = multisine.sources + 2
    measured = measure(
        desk,
        card,
        multisine,
        periods=periods,
        progress=lambda done, _total: progress(done, total),
    )
    repeats = []
    for factor in (0.5, 1.0):
        scaled = replace(multisine, level=factor * multisine.level)
        run = play_run(
            desk, card, scaled, _REPEATED_RUN, periods=periods, first_gain=measured.loopback
        )
        repeats.append(_repeats(desk, measured, scaled, run.whole))
        progress(multisine.sources + len(repeats), total)
    half_level, at_end = repeats
    measurement = replace(
        measured.responses, errors=_errors(measured), half_level=half_level, at_end=at_end
    )
    sensor_rows = []
    for number, sensor in enumerate(desk.sensors):
        sensor_rows.append(_sensor_row(sensor, measured.quality(number)))
    return MeasuredPlate(
        measurement,
        multisine.level,
        time.monotonic() - started_at,
        sensors=tuple(sensor_rows),
        notes=(),
        details={"latency_s": measured.latency, "repeated_runs": measured.repeated},
    )


def _errors(measured: MeasuredResponses) -> FloatArray:
    """Return the standard deviations of real and imaginary parts: noise and reading error."""
    responses = measured.responses
    noise = measured.std * _rms_by_sensor(responses.values)
    noise_of_parts = noise[:, :, None] / np.sqrt(2)
    return np.asarray(np.hypot(responses.std, noise_of_parts))


def _sensor_row(sensor: WiredSensor, quality: dict[str, float]) -> dict[str, Any]:
    """Return a sensor for JSON."""
    return {
        "sensor": sensor.name,
        "input": sensor.input,
        "x_m": sensor.x,
        "y_m": sensor.y,
        "coherence_min": quality["coherence_min"],
    }


def _repeats(
    desk: Desk, measured: MeasuredResponses, multisine: Multisine, recorded: FloatArray
) -> tuple[Repeat, ...]:
    """Compare the strongest lines of a run with the response to all ERAs together."""
    full_levels = list(desk.rig.full_levels.values())
    played = multisine.played(_REPEATED_RUN)
    bases = played[:, : len(full_levels)] * full_levels  # (f, eras)
    norms = np.linalg.norm(bases, axis=1, keepdims=True)
    expected = np.einsum("fse,fe->fs", measured.responses.values, bases) / norms
    samples = multisine.amplitudes_in(recorded)[:, desk.wiring.sensor_columns]
    sensitivities = [sensor.sensitivity for sensor in desk.sensors]
    accelerations = samples / sensitivities
    converters = converter_response(measured.loopback)[:, None]
    repeated = accelerations / converters / norms
    names = ", ".join(desk.wiring.era_outputs)
    magnitudes = np.linalg.norm(expected, axis=1)
    strongest = best_first(magnitudes)[:_COMPARED_LINES]
    repeats = []
    for line in strongest:
        frequency = float(multisine.frequencies[line])
        repeats.append(Repeat(names, frequency, expected[line], repeated[line]))
    return tuple(repeats)
