"""A rig's plate measured through a sound card: runs of a multisine; stepped tones as a check."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass

import numpy as np

from drivers.errors import LinkError
from model.arrays import ComplexArray, FloatArray
from model.calibration.responses import Responses
from model.progress import Progress, unseen
from sim.desk.measuring.desk import MIN_SETTLING, Desk
from sim.desk.measuring.loopback import (
    check_clocks,
    check_coherence,
    check_levels,
    check_wiring,
    is_as_late,
    is_whole,
    latency,
)
from sim.desk.measuring.multisine import PERIOD, Multisine, default_frequencies, estimate
from sim.desk.measuring.sound_card import SoundCard, open_card

_TAIL = 0.05  # s; longer than the ramp

TRIES = 3
"""Attempts of a run."""


@dataclass(frozen=True, eq=False)
class Run:
    """What was recorded of a run: whole periods of the settled plate, (n, inputs).

    loopback (f,): complex gain of the cable; is_whole: whether no block was lost, in the last
    attempt; repeated: attempts before it.
    """

    recorded: FloatArray
    loopback: ComplexArray
    is_whole: bool
    repeated: int


def run_time(periods: int, *, settling: float = MIN_SETTLING) -> float:
    """Time [s] of a run of which so many periods are analysed, after it has settled."""
    return settling + PERIOD * periods + _TAIL


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
    """Play a run, again where blocks were lost in it or since the first one.

    before (f,): the loop-back's gain in the first run, None in that. Raises InputError, LinkError
    for inputs that are clipped or silent.
    """
    seconds = run_time(periods, settling=desk.settling)
    signal = desk.on_outputs(multisine.signal(number, periods=seconds / PERIOD))
    start = round(desk.settling * multisine.rate)
    repeated = 0
    while True:
        kept = card.run(signal)[start : start + periods * multisine.samples].astype(float)
        check_levels(kept, desk.sensors, cable=(desk.output, desk.input))
        looped = kept[:, desk.input - 1]
        gain = (
            multisine.found(looped) / multisine.played(number)[:, desk.sources.index(desk.output)]
        )
        # The cable decides: drivers report losses that were none, and miss others.
        same = is_whole(looped, samples=multisine.samples)
        same = same and (before is None or is_as_late(gain, before))
        if same or repeated == tries - 1:
            return Run(kept, gain, same, repeated)
        repeated += 1


def blocks_lost() -> LinkError:
    """The error for a run that lost blocks each time."""
    return LinkError(
        f"blocks of sound were lost in {TRIES} attempts of a run; end other programs, give "
        "the sound server real-time priority, or choose larger blocks"
    )


LEVEL = 0.3
"""Usual largest sample of each output."""

Show = Callable[[Sequence[FloatArray]], None]
"""Takes what was recorded so far: whole periods of each run, (n, inputs)."""


@dataclass(frozen=True, eq=False)
class Measured:
    """Responses with what is known of them.

    coherence (f, sensors), std (f, sensors) relative to the root mean square of the sensor; latency
    [s] through the sound card; even (sensors,): of a square law; repeated: runs played again since
    blocks were lost; looped (f,): response of the loop-back.
    """

    responses: Responses
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
    opened = open_card(device, outputs=desk.output, inputs=desk.input, limit=level)
    with closing(opened) as card:
        yield card, Multisine(frequencies, len(desk.sources), card.rate, level, seed)


def measure(
    desk: Desk,
    card: SoundCard,
    multisine: Multisine,
    *,
    periods: int = 2,
    show: Show = lambda recorded: None,
    is_heard: bool = False,
) -> Measured:
    """Play all runs of a multisine and estimate the responses.

    periods: of each run that are analysed. show: called with the runs recorded so far, after each.
    is_heard: whether every ERA was heard before, at another place of a sensor that is moved.
    Raises InputError, LinkError for what is clipped, silent, swapped, incoherent, or lost three
    times.
    """
    seconds = run_time(periods, settling=desk.settling)
    desk.check_times(seconds=seconds, slew=multisine.slew)
    recorded: list[FloatArray] = []
    first: ComplexArray | None = None
    repeated, is_lost = 0, False
    for number in range(multisine.sources):
        tries = 1 if is_lost else TRIES
        run = play_run(desk, card, multisine, number, periods=periods, before=first, tries=tries)
        first = run.loopback if first is None else first
        repeated += run.repeated
        is_lost = is_lost or not run.is_whole
        recorded.append(run.recorded)
        show(recorded)
    found = estimate(multisine, recorded)
    # Another signal than the loop-back's, or another clock, looks like lost blocks; that is the
    # cause to be told.
    check_wiring(found, desk.sensors, desk.eras, loopback=desk.input, output=desk.output)
    check_clocks(multisine, recorded, desk.sensors, loopback=desk.input)
    if is_lost:
        raise blocks_lost()
    check_coherence(found, recorded, desk.sensors, desk.eras, is_heard=is_heard)
    looped, columns = found.values[:, desk.input - 1, desk.sources.index(desk.output)], desk.columns
    of_eras = found.values[:, columns, : len(desk.eras)]
    rms = np.sqrt((np.abs(of_eras) ** 2).mean(axis=(0, 2)))
    return Measured(
        desk.responses(multisine.frequencies, found.values, looped),
        found.coherence[:, columns],
        found.std[:, columns] / rms,
        latency(looped, multisine.frequencies),
        found.even[columns],
        repeated,
        looped,
    )


_PERIODS = 2
_TONES = 5
_LOUD = 0.05  # of the largest at a frequency; maxima sit in antiresonances


@dataclass(frozen=True)
class Stepped:
    """Multisine beside stepped tones, of responses above 5 % of the largest at their frequency.

    level_db, phase_deg: root mean square and largest difference; frequencies (n,) [Hz].
    """

    frequencies: FloatArray
    level_db: tuple[float, float]
    phase_deg: tuple[float, float]

    def as_json(self) -> dict[str, object]:
        """For programs."""
        return {
            "frequencies_hz": self.frequencies.tolist(),
            "level_rms_db": self.level_db[0],
            "level_max_db": self.level_db[1],
            "phase_rms_deg": self.phase_deg[0],
            "phase_max_deg": self.phase_deg[1],
        }


def check_by_steps(
    desk: Desk,
    card: SoundCard,
    measured: Measured,
    *,
    level: float,
    progress: Progress = unseen,
) -> Stepped:
    """Play some of the frequencies on each ERA alone; raises LinkError for lost blocks."""
    known = measured.responses
    rows = np.unique(np.linspace(0, len(known.frequencies) - 1, _TONES).round().astype(int))
    frequencies = known.frequencies[rows]
    values = np.empty((len(rows), desk.input, len(desk.eras) + 1), dtype=complex)
    for era in range(len(desk.eras)):
        for row, frequency in enumerate(frequencies):
            values[row, :, era] = _played(desk, card, era, frequency, level)
            progress(era * len(rows) + row + 1, len(desk.eras) * len(rows))
    found = desk.responses(frequencies, values, measured.looped[rows])
    return _compared(frequencies, known.values[rows], found)


def _played(desk: Desk, card: SoundCard, era: int, frequency: float, level: float) -> ComplexArray:
    """Amplitudes (inputs,) by full scale of one ERA; the loop-back shows lost blocks."""
    tone = Multisine(np.array([frequency]), 1, card.rate, level)
    signal = tone.signal(0, periods=run_time(_PERIODS, settling=desk.settling) / PERIOD)
    sources = np.zeros((len(signal), len(desk.eras) + 1))
    sources[:, [era, -1]] = signal
    heard = card.run(desk.on_outputs(sources)).astype(float)
    start = round(desk.settling * card.rate)
    kept = heard[start : start + _PERIODS * tone.samples]
    if card.gaps or not is_whole(kept[:, desk.input - 1], samples=tone.samples):
        raise LinkError("blocks of sound were lost between stepped tones; measure again")
    return np.asarray(tone.found(kept)[0] / tone.played(0)[0])


def _compared(frequencies: FloatArray, one: ComplexArray, other: Responses) -> Stepped:
    size = np.abs(one)
    ratio = (other.values / one)[size > _LOUD * size.max(axis=(1, 2), keepdims=True)]
    level, phase = 20 * np.log10(np.abs(ratio)), np.degrees(np.angle(ratio))
    both = [
        (float(np.sqrt((each**2).mean())), float(np.abs(each).max())) for each in (level, phase)
    ]
    return Stepped(frequencies, both[0], both[1])
