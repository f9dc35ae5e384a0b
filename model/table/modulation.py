"""Contents whose strength beats 10 to 30 times a second: a carrier and two side bands.

Of a full modulation each side band has half the amplitude of the carrier. At the carrier's weights
side bands leak 3 to 12 dB more: each has weights of its own, found like those of a content of its
frequency. The carrier is chosen for all three together, near the best steady one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.choice import best_of
from model.finger.perception import decibels
from model.table.answer import answer, figures_of
from model.table.contents import Contents, Stream
from model.table.fingers_on_plate import FingersOnPlate
from model.table.promised import promised
from model.table.request import (
    ANY_BAND,
    APART_HZ,
    MIN_CONTRAST_DB,
    Answer,
    Finger,
    Layer,
    QuietFinger,
    Request,
    verdict_of,
)
from model.table.table import LocalizationTable
from model.vibration.excitation import Excitation, base_amplitudes

_SIDE = 0.5  # amplitude of a side band to the carrier's
_ALL_DB = 10 * math.log10(1 + 2 * _SIDE**2)  # of all three above the carrier
_NEAR = 2  # carriers tried on each side of the steady one, by frequencies of the table
_SAME = 0.5  # Hz; by which both side bands may differ in distance from the carrier


@dataclass(frozen=True)
class _Modulated:
    """A carrier and two side bands [dB of contrast on their own], all at their levels."""

    tones: tuple[Layer, Layer, Layer]

    @property
    def contrast_db(self) -> float:
        """Promised contrast of all three: what leaks adds up."""
        leaks = [
            share**2 * 10 ** (-each.promised_contrast_db / 10)
            for share, each in zip((1.0, _SIDE, _SIDE), self.tones, strict=True)
            if each.promised_contrast_db is not None
        ]
        return math.inf if not leaks else _ALL_DB - 10 * math.log10(sum(leaks))


def with_modulation(
    table: LocalizationTable,
    requests: Sequence[Request],
    fingers: Sequence[Finger],
    found: Answer,
    modulations: Sequence[float | None],
    *,
    playable: tuple[float, float] = ANY_BAND,
) -> Answer:
    """Return an answer whose contents are modulated [Hz] where that leaves all fingers served.

    modulations: of each request, None for none; playable: lowest and highest frequency [Hz] of side
    bands. These are as far below as above the carrier, where the table has a frequency nearest to
    the modulation, and APART_HZ from all tones of other contents.
    """
    layers = [*found.layers]
    every: list[Request | Finger] = [*requests, *fingers]
    for number, modulation in enumerate(modulations):
        if modulation is None or layers[number].verdict not in ("own", "mixed"):
            continue
        if any(each.verdict == "shared" and each.excitation == layers[number].excitation
               for each in layers):  # fmt: skip
            continue
        taken = [f for n, each in enumerate(layers) if n != number for f in _frequencies(each)]
        best = _modulated(table, every, number, layers[number], modulation, taken, playable)
        if best is None:
            continue
        carrier, *sides = best.tones
        tried = [*layers]
        tried[number] = replace(
            layers[number],
            excitation=_scaled(carrier.excitation, -_ALL_DB),
            side_bands=tuple(
                _scaled(each.excitation, -_ALL_DB + float(decibels(_SIDE))) for each in sides
            ),
        )
        promised = _promised(table, every, tried, found)
        if _is_served(promised, fingers, found.promised_worst_db):
            layers, found = [*promised.layers], promised
    return found


def with_gains(
    table: LocalizationTable,
    requests: Sequence[Request],
    fingers: Sequence[Finger],
    found: Answer,
    gains_db: Sequence[float],
) -> Answer | None:
    """Return an answer with a gain on each layer, None where a finger would not be served.

    Fingers that share a content have one gain.
    """
    layers = [
        replace(
            layer,
            excitation=_scaled(layer.excitation, gain_db),
            side_bands=tuple(_scaled(tones, gain_db) for tones in layer.side_bands),
        )
        for layer, gain_db in zip(found.layers, gains_db, strict=True)
    ]
    promised = _promised(table, [*requests, *fingers], layers, found)
    return promised if _is_served(promised, fingers, found.promised_worst_db) else None


def _is_served(found: Answer, fingers: Sequence[Finger], steady_db: float | None) -> bool:
    """Whether all fingers have what they require, and no less than 6 dB unless they had less."""
    worst = found.promised_worst_db
    if worst is not None and steady_db is not None and worst < min(MIN_CONTRAST_DB, steady_db):
        return False
    bounds = [each.request.max_foreign_db_sl for each in found.layers]
    levels = [each.foreign_level_db_sl for each in found.layers]
    bounds += [each.max_foreign_db_sl for each in fingers]
    levels += [each.level_db_sl for each in found.quiet]
    return all(
        level is None or level <= bound for level, bound in zip(levels, bounds, strict=True)
    ) and all(
        each.promised_contrast_db is None
        or each.verdict == "held back"
        or each.promised_contrast_db >= each.request.min_contrast_db
        for each in found.layers
    )


def frequency_of(layer: Layer) -> float:
    """Return the frequency of a layer's carrier [Hz]; infinite for none."""
    return next((tone.frequency for tone in layer.excitation.values()), math.inf)


def _frequencies(layer: Layer) -> list[float]:
    """Frequencies of a layer's tones [Hz]."""
    every = (layer.excitation, *layer.side_bands)
    return [tone.frequency for tones in every for tone in [*tones.values()][:1]]


def _modulated(
    table: LocalizationTable,
    every: Sequence[Request | Finger],
    number: int,
    layer: Layer,
    modulation: float,
    taken: Sequence[float],
    playable: tuple[float, float],
) -> _Modulated | None:
    """The best carrier with its side bands; None where the table has none."""
    frequencies = table.frequencies
    low, high = layer.request.band_hz
    lowest, highest = max(playable[0], frequencies[0]), min(playable[1], frequencies[-1])
    row = int(np.argmin(np.abs(frequencies - frequency_of(layer))))
    around = range(max(row - _NEAR, 0), min(row + _NEAR + 1, len(frequencies)))
    alone: dict[int, Layer] = {}
    tried: list[_Modulated] = []
    for carrier in around:
        f = float(frequencies[carrier])
        above = int(np.argmin(np.abs(frequencies - f - modulation)))
        gap = frequencies[above] - f
        sides = [int(np.argmin(np.abs(frequencies - f + gap))), above]
        is_even = gap > 0 and abs(f - frequencies[sides[0]] - gap) <= _SAME
        tones = [f, *frequencies[sides]]
        is_within = low <= f <= high and lowest <= f - max(gap, modulation)
        is_within = is_within and f + max(gap, modulation) <= highest
        is_apart = all(abs(tone - other) >= APART_HZ for tone in tones for other in taken)
        if not (is_even and is_within and is_apart):
            continue
        for each in (carrier, *sides):
            if each not in alone:
                alone[each] = _alone(table, every, number, float(frequencies[each]))
        tried.append(_Modulated((alone[carrier], alone[sides[0]], alone[sides[1]])))
    return tried[best_of([each.contrast_db for each in tried])] if tried else None


def _alone(
    table: LocalizationTable, every: Sequence[Request | Finger], number: int, frequency: float
) -> Layer:
    """The only content at a finger, at a frequency, all others quiet."""
    own = every[number]
    if not isinstance(own, Request):
        raise TypeError("a content must be that of a request")
    others = [Finger(each.at, each.load) for n, each in enumerate(every) if n != number]
    request = replace(own, band_hz=(frequency, frequency), min_contrast_db=-math.inf)
    (layer,) = answer(table, [request], others, min_contrast_db=-math.inf).layers
    return layer


def _promised(
    table: LocalizationTable,
    every: Sequence[Request | Finger],
    layers: Sequence[Layer],
    found: Answer,
) -> Answer:
    """The answer with what all tones of layers promise together, on the same plates."""
    owners, rows, weights, streams = list[int](), list[int](), [], list[Stream]()
    strokes = np.array([era.stroke for era in table.eras])
    for layer in layers:
        if not layer.excitation or layer.verdict == "shared":
            continue
        for voice in (layer.excitation, *layer.side_bands):
            frequencies, bases = base_amplitudes(voice, table.eras)
            owners.append(len(streams))
            rows.append(int(np.searchsorted(table.frequencies, frequencies[0])))
            weights.append(bases[0] / strokes)
        targets = [n for n, each in enumerate(layers) if each.excitation == layer.excitation]
        streams.append(Stream(tuple(targets), layer.request.level_db_sl, ()))
    protected = [
        number
        for number, each in enumerate(layers)
        if not each.excitation and each.foreign_level_db_sl is not None
    ]
    places, loads = tuple(each.at for each in every), tuple(each.load for each in every)
    contents = Contents(
        places, loads, tuple(streams), (*protected, *range(len(layers), len(every)))
    )
    tones = promised(
        FingersOnPlate.of(table, places, loads),
        contents,
        np.array(rows),
        np.array(weights, dtype=np.complex64),
        np.array(owners),
        at_levels=False,
    )
    new = [*layers]
    for number in protected:
        new[number] = replace(new[number], foreign_level_db_sl=tones.foreign_db_sl[number])
    for number in (finger for stream in streams for finger in stream.targets):
        new[number] = replace(new[number], **figures_of(tones, number))
        if new[number].verdict != "shared":
            verdict = verdict_of(new[number].promised_contrast_db)
            new[number] = replace(new[number], verdict=verdict)
    quiet = [
        QuietFinger(each.at, contrast[0], contrast[2], level)
        for each, contrast, level in zip(
            found.quiet,
            tones.contrast_db[len(layers) :],
            tones.foreign_db_sl[len(layers) :],
            strict=True,
        )
    ]
    worst = None if math.isnan(tones.worst_db) else tones.worst_db
    return replace(found, layers=tuple(new), quiet=tuple(quiet), promised_worst_db=worst)


def _scaled(excitation: Excitation, gain_db: float) -> Excitation:
    factor = 10 ** (gain_db / 20)
    return {
        name: replace(tone, amplitude=factor * tone.amplitude) for name, tone in excitation.items()
    }
