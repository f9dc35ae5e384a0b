"""Measure a plate through a sound card, and detect errors in the measurement.

A measurement consists of several runs of a multisine, from which responses are estimated and
checked. The loop-back cable reveals delay, converter response, lost blocks, and inputs on another
clock than the outputs. The clocks of two devices, or of an aggregate of two, drift by 10 to 100
ppm. The runs are then no longer orthogonal, and no other check detects this if the loop-back has
the right clock.

A single sensor can be moved from position to position by a person at a terminal. Every position is
a separate measurement. Phases are relative to the loop-back, so that positions measured minutes
apart agree. The file is written after each position, so that the measurement can be resumed.

For identification, one run is repeated at half level and at full level.
"""

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import LinkError
from era_haptics.lab.measuring.sound_card import (
    PERIOD,
    TRIES,
    Desk,
    DeviceLost,
    Multisine,
    ResponseEstimate,
    Run,
    SoundCard,
    WiredSensor,
    converters,
    estimate,
    multisine_frequencies,
    open_card,
    play_and_record,
    read_sensors,
    run_time,
)
from model.arrays import ComplexArray, FloatArray, best_first
from model.commands.options import Stopwatch, progress_bar
from model.errors import InputError
from model.estimate.measurement import (
    MeasuredPlate,
    Measurement,
    Repeat,
    measurement_of,
    read_measured,
    write_responses,
)
from model.processes import Progress, unseen
from model.rig.rig import Rig

SILENT = 1e-5
"""Of full scale, rms: what an input without a signal stays below."""

_MAX_DELAY = 0.1  # s; lines 10 Hz apart repeat then
_NEARLY = 0.95
_STRAIGHT = 0.5  # rad
_AS_LATE = 0.02  # of the gain; one sample more at 500 Hz and 48 kHz makes 0.065
_SAME = 1e-3  # of periods; a lost block makes them differ by 0.8


def has_all_blocks(periods: FloatArray, *, samples: int) -> bool:
    """Return whether all periods of the loop-back (n,) are equal: no block was lost between them.

    False for a silent loop-back, which cannot show lost blocks.
    """
    each = periods.reshape(-1, samples)
    size = np.linalg.norm(each[0])
    differ = np.linalg.norm(each - each[0], axis=1).max()
    return bool(size > SILENT * np.sqrt(samples) and differ <= _SAME * size)


def latency(response: ComplexArray, frequencies: FloatArray) -> float:
    """Delay [s] of a response at frequencies [Hz], from 0 to 0.1 s, by the slope of its phase.

    Lines d apart tell delays below 1 / d apart only.

    Raises LinkError where the phase is no straight line, so that nothing is known of the delay.
    """
    unit = response / np.abs(response)
    tried = np.arange(0, _MAX_DELAY, 0.1 / frequencies.max())
    alike = np.abs(np.exp(2j * np.pi * np.outer(tried, frequencies)) @ unit)
    # Lines at equal distances have several such delays: the shortest is meant.
    near = np.flatnonzero(alike > _NEARLY * alike.max())
    nearest = tried[near[0]]
    rest = unit * np.exp(2j * np.pi * frequencies * nearest)
    phase = np.angle(rest / rest.mean())
    slope, first = np.polyfit(frequencies, phase, 1)
    if np.abs(phase - slope * frequencies - first).max() > _STRAIGHT:
        raise LinkError(
            f"loop-back: its phase must correspond to a delay of up to {1e3 * _MAX_DELAY:g} ms; "
            f"check "
            "the cable, and that no other signal feeds this input"
        )
    return float(nearest - slope / (2 * np.pi))


_TOLERANCE = 2e-6
"""Of a clock; 13 s of measuring turn 500 Hz by 5 degrees."""

_MAX_DRIFT = 1e-3  # a lost block of 64 samples at 48 kHz looks like more
_ALIKE = 0.999
_SURE = 5.0  # standard errors


def certain_drift(multisine: Multisine, runs: Sequence[FloatArray]) -> float:
    """Drift of an input's clock relative to the outputs', from whole periods of each run, (n,).

    Least squares of the phase 2 pi f t drift between the first and the last period, t apart,
    weighted by the power of each line. 0 if the drift is within its error, or if it does not
    explain the difference between the periods (a lost block does not drift).
    """
    n = multisine.samples
    first = np.array([multisine.found(each[:n]) for each in runs])
    last = np.array([multisine.found(each[-n:]) for each in runs])
    apart = PERIOD * (len(runs[0]) / n - 1)
    turned = last * first.conj()
    weights = np.abs(turned)
    slopes = np.broadcast_to(2 * np.pi * multisine.frequencies * apart, weights.shape)
    phases = np.angle(turned)
    moment = max(float((weights * slopes**2).sum()), 1e-300)
    relative = float((weights * slopes * phases).sum()) / moment
    rest = phases - slopes * relative
    error = np.sqrt(float((weights**2 * slopes**2 * rest**2).sum())) / moment
    alike = np.abs((turned * np.exp(-1j * slopes * relative)).sum()) / max(weights.sum(), 1e-300)
    is_large = max(_TOLERANCE, _SURE * error) < abs(relative) < _MAX_DRIFT
    return relative if is_large and alike > _ALIKE else 0.0


_FULL = 0.999  # of full scale
_LOOPED = 0.05  # of a sample that a loop-back brings back at least
CROSSTALK = 0.02  # of the loop-back, allowed for other outputs
_COHERENT = 0.9  # in the median over frequencies
_FAINT = 0.01  # of full scale; below it, converter noise is audible next to the signal
_MOVED = 5.0  # times the noise, in the median over frequencies and the maximum over sensors


def check_levels(recorded: FloatArray, named: Mapping[int, str]) -> None:
    """Raise InputError for clipped inputs, LinkError for silent ones, in one run (n, inputs).

    named: what is connected to each input to be checked, by input number from 1.
    """
    clipped = [name for n, name in named.items() if np.abs(recorded[:, n - 1]).max() >= _FULL]
    if clipped:
        raise InputError(
            f"inputs must stay below full scale, got clipping of {', '.join(clipped)}; turn down "
            "the gain of the input, and its full_scale_v, or choose a lower --level"
        )
    silent = [n for n in named if np.sqrt((recorded[:, n - 1] ** 2).mean()) < SILENT]
    if len(silent) == len(named) > 1:
        raise LinkError(
            "all inputs are silent: check that --device is the connected sound card, that outputs "
            "and inputs are not swapped, and that amplifier and sensor supply are switched on"
        )
    if silent:
        inputs = ", ".join(f"{named[n]} (input {n})" for n in silent)
        raise LinkError(f"silent: {inputs}; check cables, amplifier and sensor supply (IEPE)")


def check_wiring(found: ResponseEstimate, desk: Desk) -> None:
    """Raise InputError unless the loop-back, and no sensor, has its output by a cable.

    A cable brings back one output alone. Sensors of a single source do so, too, and may.
    """
    came = np.median(np.abs(found.values), axis=0)  # (inputs, sources)
    own, at, output, named = desk.looped, desk.input, desk.output, desk.named_inputs
    first, others = came.max(axis=1), np.sort(came, axis=1)[:, :-1].max(axis=1, initial=0.0)
    may_tell = (len(desk.sources) > 1) | (np.arange(1, 1 + len(came)) == at)
    is_cable = (first > _LOOPED) & (others < CROSSTALK * first) & may_tell
    by_cable = np.where(is_cable, came.argmax(axis=1), -1)  # source at each input, -1 for none
    looped, heard = came[at - 1, own], came[at - 1] * (np.arange(came.shape[1]) != own)
    of_eras = [f"output {to} of ERA {name}" for name, to in desk.eras]
    other = f"{heard.max():.2g} of {of_eras[heard.argmax()]}"
    back = np.flatnonzero(by_cable == own) + 1
    what = f"input {at} must bring back output {output} alone, as the loop-back, got"
    if by_cable[at - 1] not in (own, -1):
        raise InputError(f"{what} {other}: outputs are swapped; exchange their cables")
    if back.size and at not in back:
        raise InputError(
            f"the loop-back of output {output} must come back at input {at}, got it at input "
            f"{back[0]}, {named.get(back[0], 'of no sensor')}: inputs are swapped; exchange "
            "their cables"
        )
    if looped <= _LOOPED:
        raise InputError(f"{what} a gain of {looped:.2g}; connect them by a cable")
    if at not in back:
        raise InputError(f"{what} {other}, too; check mixers and monitoring of the sound card")
    for n in (each.input for each in desk.sensors if by_cable[each.input - 1] >= 0):
        raise InputError(
            f"input {n} must have {named[n]}, got output {desk.sources[by_cable[n - 1]]} as "
            "through a cable; check the plug of that sensor, Y cables and monitoring of the sound "
            "card"
        )


def _check_clocks(multisine: Multisine, recorded: Sequence[FloatArray], desk: Desk) -> None:
    """Raise InputError for inputs with another clock than the outputs'; runs (n, inputs) each."""
    found = [
        f"{1e6 * drift:.0f} ppm at {name} (input {n})"
        for n, name in desk.named_inputs.items()
        if (drift := certain_drift(multisine, [each[:, n - 1] for each in recorded]))
    ]
    if found:
        raise InputError(
            f"inputs must have the clock of the outputs, got a drift of {', '.join(found)}; use "
            "one sound card, or a common word clock or ADAT clock"
        )


def check_coherence(
    found: ResponseEstimate,
    recorded: Sequence[FloatArray],
    desk: Desk,
    *,
    is_heard: bool = False,
) -> None:
    """Raise LinkError for sensors with other signals, and for ERAs that move no sensor.

    found: estimated from recorded, runs of (n, inputs); is_heard: whether every ERA was detected at
    another position.
    """
    coherence = np.median(found.coherence[:, desk.columns], axis=0)
    peaks = np.max([np.abs(each[:, desk.columns]).max(axis=0) for each in recorded], axis=0)
    for are_faint, remedy in (
        (True, "too low a level: choose a higher --level, or turn up the gain of the input"),
        (False, "fix these sensors to the plate, check their cables and mains hum"),
    ):
        incoherent = [
            f"{sensor.name} ({each:.2f}, input up to {100 * peak:.2g} % of full scale)"
            for sensor, each, peak in zip(desk.sensors, coherence, peaks, strict=True)
            if each < _COHERENT and (peak < _FAINT) == are_faint
        ]
        if incoherent:
            raise LinkError(
                f"coherence must be at least {_COHERENT:g} in the median, got "
                f"{', '.join(incoherent)}; {remedy}"
            )
    moved = np.abs(found.values[:, desk.columns]) / found.std[:, desk.columns, None]
    for (name, at), each in zip(desk.eras, np.median(moved, axis=0).max(axis=0), strict=False):
        if each < _MOVED:
            raise LinkError(
                f"output {at} is not heard here, but was at another place: this one is near a "
                f"nodal line for ERA {name}; s skips it, or move it by a few cm, in its line of "
                "--sensors too (q, then --resume); if the next place does not hear it either, "
                "check its cable"
                if is_heard
                else f"output {at} moves nothing: check ERA {name}, its amplifier and its cable"
            )


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
        is_late = False
        if before is not None:  # a block that was lost between two runs changes the delay
            changed = np.abs(loopback_gain(desk, multisine, number, kept) - before).max()
            is_late = bool(changed > _AS_LATE * np.abs(before).max())
        return not is_late and has_all_blocks(kept[:, desk.input - 1], samples=multisine.samples)

    seconds = run_time(periods, settling=desk.settling)
    signal = desk.on_outputs(multisine.signal(number, periods=seconds / PERIOD))
    return play_and_record(
        card,
        signal,
        settling=desk.settling,
        seconds=PERIOD * periods,
        is_whole=is_same,
        tries=tries,
    )


_LEVEL = 0.3
"""Usual largest sample of each output."""


@dataclass(frozen=True, eq=False)
class MeasuredResponses:
    """Responses with their uncertainty and quality.

    - coherence (f, sensors).
    - std (f, sensors): relative to the RMS of the sensor's responses.
    - latency [s]: through the sound card.
    - even (sensors,): even harmonics, which indicate a square law.
    - repeated: number of runs repeated because of lost blocks.
    - looped (f,): response of the loop-back.
    """

    responses: Measurement
    coherence: FloatArray
    std: FloatArray
    latency: float
    even: FloatArray
    repeated: int
    looped: ComplexArray

    def quality(self, sensor: int) -> dict[str, float]:
        """Return quality figures of the sensor with a given number, for JSON."""
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
    level = min(_LEVEL, desk.highest) if level is None else level
    desk.check(level)
    if frequencies is None:
        limits = desk.rig.limits
        frequencies = multisine_frequencies(limits.frequency_min, limits.frequency_max)
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

    periods: analysed periods per run. progress: called with the number of runs done and the total.
    is_heard: whether every ERA was detected before, at another position of a moved sensor. Raises
    InputError or LinkError for inputs that are clipped, silent, swapped or incoherent, and for
    blocks lost three times in a row.
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
    # A wrong loop-back signal, or another clock, looks like lost blocks; report the cause instead.
    check_wiring(found, desk)
    _check_clocks(multisine, recorded, desk)
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
_COMPARED = 2  # lines of the loop-back


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

    level, frequencies, seed: see `open_desk`; periods: analysed periods per run. Raises InputError,
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
    # Responses with the usual reading error, in addition to the noise.
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
    """Compare the strongest lines of a run with the response to all ERAs together."""
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


_MOVED_BY = 0.02  # of the response, or so many times its noise:
_OF_NOISE = 3.0
_APART = 5e-3  # m; nearer places may sound alike
_AT = 5e-4  # m, tolerance between positions in a file and the sensors' positions
_NOISY = 0.03  # of the response


@dataclass(eq=False)
class PositionsFile:
    """Responses measured at the positions of a desk with one multisine, and their file.

    values (f, eras) [1/s²] by position name.
    """

    path: Path
    desk: Desk
    multisine: Multisine
    values: dict[str, ComplexArray] = field(default_factory=dict)

    @property
    def setting(self) -> str:
        """What must be the same at all places, in words of the file."""
        grams = 1e3 * self.desk.sensors[0].mass
        rig = self.desk.rig.fingerprint[:8]
        return f"level {self.multisine.level:g}, sensor {grams:.6g} g, rig {rig}"

    @property
    def missing(self) -> list[WiredSensor]:
        """Places that are not measured, in the order of their file."""
        return [place for place in self.desk.sensors if place.name not in self.values]

    def read(self) -> None:
        """Resume from the file; raises InputError if it belongs to another measurement."""
        measured, played = read_measured(self.path), self.multisine.frequencies
        settings = {each.setting for each in measured} - {self.setting}
        if settings:
            raise self._other("setting", self.setting, " and ".join(settings) or "none")
        found = measurement_of(measured, self.desk.rig)
        if found.skipped or not np.array_equal(found.frequencies.round(6), played.round(6)):
            raise self._other("frequencies", _span(played), _span(found.frequencies))
        for at, values in zip(found.points.tolist(), found.values.swapaxes(0, 1), strict=True):
            self.values[self._place_at(at).name] = values

    def keep(self, place: WiredSensor, found: MeasuredResponses) -> None:
        """Write the file with another place; raises OSError."""
        self.values[place.name] = found.responses.values[:, 0]
        places = [place for place in self.desk.sensors if place.name in self.values]
        measured = Measurement(
            tuple(place.place for place in places),
            self.multisine.frequencies,
            np.stack([self.values[place.name] for place in places], axis=1),
        )
        write_responses(self.path, measured, self.desk.rig, setting=self.setting)

    def _place_at(self, at: Sequence[float]) -> WiredSensor:
        for place in self.desk.sensors:
            if math.dist((place.x, place.y), at) <= _AT:
                return place
        raise self._other("places", "one at each line of --sensors", f"({at[0]:g}, {at[1]:g}) m")

    def __str__(self) -> str:
        """How far it is, in a line."""
        count, total = len(self.values), len(self.desk.sensors)
        text = f"{count} of {total} places are measured" + (f", in {self.path}" if count else "")
        return f"{text}; go on with --resume" if 0 < count < total else text

    def _other(self, what: str, expected: str, got: str) -> InputError:
        return InputError(
            f"--resume {self.path}: {what} must be {expected}, got {got} in the file; measure as "
            "it was begun, or leave out --resume and write another file"
        )


def measure_by_moving(
    desk: Desk,
    opened: AbstractContextManager[tuple[SoundCard, Multisine]],
    output: Path,
    *,
    periods: int,
    is_resumed: bool,
) -> tuple[list[str], dict[str, Any], bool]:
    """Guide a person at a terminal through the positions of a desk.

    Return the report, and whether all positions are measured. Raises InputError, LinkError,
    KeyboardInterrupt, after printing what is saved.
    """
    if output.exists() != is_resumed:
        raise InputError(
            f"{output}: a file must be there to go on from with --resume, got none; leave it out"
            if is_resumed
            else f"{output}: exists; go on with --resume, or choose another name"
        )
    with Stopwatch() as timed, opened as (card, multisine):
        file = PositionsFile(output, desk, multisine)
        if is_resumed:
            file.read()
            _tell(str(file))
        try:
            found = measure_positions(file, card, periods=periods)
        except KeyboardInterrupt:
            card.close()  # silence the outputs before printing
            _tell(f"\nstopped; {file}")
            raise
        except DeviceLost as problem:
            raise LinkError(f"{problem}; check its cable; {file}") from problem
    missing = [place.name for place in file.missing]
    answer = {
        "frequencies_hz": multisine.frequencies.tolist(),
        "places": {"measured": [*found], "missing": missing},
        "sensors": {name: each.quality(0) for name, each in found.items()},
        "measure_time_s": timed.elapsed,
        "files": [str(output)] if file.values else [],
    }
    return [str(file)], answer, not missing


def _prompt(text: str) -> str:
    sys.stderr.write(text)
    sys.stderr.flush()
    return sys.stdin.readline() or "q"


def _tell(text: str) -> None:
    sys.stderr.write(f"{text}\n")


def measure_positions(
    file: PositionsFile,
    card: SoundCard,
    *,
    periods: int,
    prompt: Callable[[str], str] = _prompt,
    tell: Callable[[str], None] = _tell,
) -> dict[str, MeasuredResponses]:
    """Guide a person through the missing positions; returns the new measurements by position.

    prompt: shows an instruction and returns the input, "q" to stop; tell: prints a line. A position
    that fails a check is reported with its remedy, and repeated. Raises DeviceLost, OSError;
    earlier measurements are then in the file.
    """
    found: dict[str, MeasuredResponses] = {}
    todo = file.missing
    last: WiredSensor | None = None
    tell(
        "Enter: measure this position; r: repeat the previous one; s: skip; q: stop. Measured "
        "positions are saved"
    )
    while todo:
        place, places = todo[0], file.desk.sensors
        reply = prompt(
            f"Put the sensor at {place.name}, x {1e3 * place.x:g} mm, y {1e3 * place.y:g} mm "
            f"(place {places.index(place) + 1} of {len(places)}), then Enter: "
        )
        match reply.strip().lower():
            case "q":
                break
            case "s":
                todo.pop(0)
            case "r" if last is not None:
                todo.insert(0, last)
                last = None
            case "":
                try:
                    measured = measure(
                        replace(file.desk, sensors=(place,)),
                        card,
                        file.multisine,
                        periods=periods,
                        is_heard=bool(file.values),
                    )
                    _check_moved(file, place, measured)
                except DeviceLost:
                    raise
                except (InputError, LinkError) as problem:
                    tell(f"{place.name} is not kept: {problem}")
                    continue
                file.keep(place, measured)
                found[place.name] = measured
                last = todo.pop(0)
                tell(_line(place, measured))
            case _:
                tell(f"a reply must be Enter, s, q, or r once, got {reply.strip()[:20]!r}")
    return found


def _check_moved(file: PositionsFile, place: WiredSensor, found: MeasuredResponses) -> None:
    """Raise InputError for a response that matches another position."""
    own = found.responses.values[:, 0]
    limit = max(_MOVED_BY, _OF_NOISE * float(np.median(found.std)))
    for other in file.desk.sensors:
        is_near = math.dist((place.x, place.y), (other.x, other.y)) < _APART
        before = file.values.get(other.name)
        if before is None or is_near or other.name == place.name:
            continue
        difference = float(np.linalg.norm(own - before) / np.linalg.norm(before))
        if difference < limit:
            raise InputError(
                f"response must differ from that at {other.name} by more than {100 * limit:.1f} %, "
                f"got {100 * difference:.1f} %: the sensor is still there; move it to {place.name}"
            )


def _line(place: WiredSensor, found: MeasuredResponses) -> str:
    noise = float(np.median(found.std))
    text = (
        f"{place.name}: coherence {np.median(found.coherence):.4f}, noise {100 * noise:.2f} % of "
        "the response; kept"
    )
    if noise > _NOISY:
        text += "; it is noisy: raise --periods in another measurement"
    return text


def _span(frequencies: FloatArray) -> str:
    return f"{len(frequencies)} from {frequencies[0]:g} to {frequencies[-1]:g} Hz"
