"""One answer to the requests of all fingers, and what is done where not all can be served.

A promise below the least contrast at the worst finger is not served as requested. In this order,
and each only where the requests allow it: the nearest two fingers that may share feel one content;
the finger of the lowest priority that need not be protected gives up content and protection; the
content of the lowest priority is held back. Where nothing reaches it, the best tried is served.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from model.arguments import expect_at_least
from model.arrays import Float32Array, FloatArray, IntArray
from model.choice import best_by, best_of
from model.drive_modes import UNRESTRICTED
from model.drive_modes.forms import Weights
from model.drive_modes.tones import excitation_of
from model.ensemble.touched_by_kernel import touch
from model.errors import InputError
from model.finger.perception import decibels
from model.table.combinations import Stream
from model.table.contents import (
    Chosen,
    choose_contents,
    contrasts,
    felt_amplitudes,
    loudest_power,
    own_amplitudes,
    promise,
    tones_chosen,
)
from model.table.fingers_on_plate import FingersOnPlate
from model.table.pattern_choice import PROMISED_PERCENTILE, UnreachableLevel
from model.table.question import Question
from model.table.request import (
    APART_HZ,
    MIN_CONTRAST_DB,
    OWN_CONTRAST_DB,
    Answer,
    Finger,
    Layer,
    QuietFinger,
    Request,
    check_requests,
)
from model.table.table import LocalizationTable
from model.vibration.excitation import base_amplitudes


def answer(
    table: LocalizationTable,
    requests: Sequence[Request],
    fingers: Sequence[Finger] = (),
    *,
    apart_hz: float = APART_HZ,
    bands_may_swap: bool = False,
    min_contrast_db: float = MIN_CONTRAST_DB,
) -> Answer:
    """Answer the requests of all fingers at once, each with a tone of its own.

    fingers: those that are to feel nothing; apart_hz: distance of the contents' frequencies, where
    their bands allow it; bands_may_swap: whether a content may have the band of another one;
    min_contrast_db: below which the promise at the worst finger is not served as requested. Levels
    are lowered by one factor where the ERAs' stroke does not allow all; higher priorities first.
    Raises InputError for requests that contradict each other, and a band without frequencies.
    """
    expect_at_least(apart_hz, 0.0, what="apart_hz")
    check_requests(requests, fingers, table.plate)
    return _Answering(table, tuple(requests), tuple(fingers), apart_hz, bands_may_swap).answer(
        min_contrast_db
    )


@dataclass(frozen=True)
class _Plan:
    """Which fingers, by index, feel which content and which are quiet.

    contents: the fingers of each, its own first; quiet: those that are protected; held: contents
    given up, with the contrast that they would have had; applied: what was changed, in words.
    """

    contents: tuple[tuple[int, ...], ...]
    quiet: tuple[int, ...]
    held: tuple[tuple[int, float], ...] = ()
    applied: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _Measured:
    """What a plan gives: by finger, and at the worst one on nine of ten plates."""

    layers: dict[int, Layer]
    quiet: dict[int, QuietFinger]
    worst_db: float | None
    stroke_factor: float
    applied: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Answering:
    """Requests and quiet fingers on a table's plate, numbered in this order."""

    table: LocalizationTable
    requests: tuple[Request, ...]
    fingers: tuple[Finger, ...]
    apart_hz: float
    bands_may_swap: bool

    def answer(self, min_contrast_db: float) -> Answer:
        """Change the plan until the worst finger has the contrast, else take the best tried."""
        count = len(self.requests)
        quiet = range(count, count + len(self.fingers))
        plan = _Plan(tuple((number,) for number in range(count)), tuple(quiet))
        tried = [(plan, self._measure(plan))]
        while _worst_of(tried[-1]) < min_contrast_db and len(tried[-1][0].contents) > 1:
            plan = self._with_less(*tried[-1])
            tried.append((plan, self._measure(plan)))
        below: tuple[str, ...] = ()
        if _worst_of(tried[-1]) < min_contrast_db:
            tried.append(best_by(tried, _worst_of))
            below = (f"nothing reaches {min_contrast_db:g} dB: the best that was tried is served",)
        plan, found = tried[-1]
        for number, contrast in plan.held:
            heard_there = found.quiet.get(number)
            found.layers[number] = Layer(
                self.requests[number],
                {},
                "held back",
                promised_contrast_db=contrast,
                foreign_level_db_sl=None if heard_there is None else heard_there.level_db_sl,
            )
        return Answer(
            tuple(found.layers[number] for number in range(count)),
            tuple(found.quiet[number] for number in quiet),
            found.worst_db,
            found.stroke_factor,
            plan.applied + below + found.applied,
        )

    @cached_property
    def _every(self) -> tuple[Request | Finger, ...]:
        return (*self.requests, *self.fingers)

    def _with_less(self, plan: _Plan, found: _Measured) -> _Plan:
        """The plan after the next step of the rule."""
        requests, contents = self.requests, plan.contents
        pairs = [
            (one, other)
            for number, one in enumerate(contents)
            for other in contents[:number]
            if all(requests[finger].may_share for finger in (*one, *other))
        ]
        if pairs:
            near = [
                -min(math.dist(requests[a].at, requests[b].at) for a in one for b in other)
                for one, other in pairs
            ]
            pair = sorted(pairs[best_of(near)], key=lambda each: -requests[each[0]].priority)
            one, other = pair
            return replace(
                plan,
                contents=tuple(
                    (*one, *other) if each == one else each for each in contents if each != other
                ),
                applied=(*plan.applied, f"{_at(requests[other[0]])} shares the content of "
                         f"{_at(requests[one[0]])}"),
            )  # fmt: skip
        least = min(requests[each[0]].priority for each in contents)
        lowest = [each for each in contents if requests[each[0]].priority == least]
        open_ = [
            each for each in lowest if not any(requests[finger].is_protected for finger in each)
        ]
        given_up = (open_ or lowest)[-1]
        figures = [(finger, found.layers[finger].promised_contrast_db) for finger in given_up]
        verb = "is neither served nor protected" if open_ else "is held back"
        return _Plan(
            tuple(each for each in contents if each != given_up),
            plan.quiet if open_ else (*plan.quiet, *given_up),
            (*plan.held, *((finger, -math.inf if c is None else c) for finger, c in figures)),
            (*plan.applied, f"content of {_at(requests[given_up[0]])} {verb}"),
        )

    @cached_property
    def _on_plate(self) -> FingersOnPlate:
        """All fingers on the plate, at the frequencies of all bands."""
        table, every = self.table, self._every
        question = Question(
            tuple(each.at for each in every), loads=tuple(each.load for each in every)
        )
        tips = table.read_fingertips(question.contacts)
        return FingersOnPlate.of(
            touch(table.on_eras, tips.few[:, 0], question.loads),
            tips,
            question,
            self._rows,
            threshold=table.thresholds,
            error_power=table.error_power,
        )

    @cached_property
    def _rows(self) -> IntArray:
        """Rows of the table's frequencies that any band holds."""
        return np.unique(np.concatenate([self._band(each) for each in self.requests]))

    def _band(self, request: Request) -> IntArray:
        frequencies, (low, high) = self.table.frequencies, request.band_hz
        rows = np.flatnonzero((frequencies >= low) & (frequencies <= high))
        if len(rows) == 0:
            raise InputError(
                f"band of {_at(request)} must be LOW-HIGH in Hz and hold a frequency of the table, "
                f"{frequencies[0]:g} to {frequencies[-1]:g} Hz, of which "
                f"{frequencies[np.abs(frequencies - low).argmin()]:g} Hz is the nearest, got "
                f"{low:g}-{high:g}"
            )
        return rows

    def _streams(self, plan: _Plan) -> list[Stream]:
        bands = [np.searchsorted(self._rows, self._band(each)) for each in self.requests]
        return [
            Stream(
                each,
                max(self.requests[finger].level_db_sl for finger in each),
                tuple(bands) if self.bands_may_swap else (bands[each[0]],),
            )
            for each in plan.contents
        ]

    def _measure(self, plan: _Plan) -> _Measured:
        """What fingers feel of a plan's contents."""
        streams = self._streams(plan)
        frequencies, weights = self.table.frequencies, self._on_plate.tips.fine_weights
        chosen = self._choose(streams, plan.quiet)
        gains, factor = self._gains(streams, chosen)
        power = chosen.power * np.square(gains, dtype=np.float32)[:, None, None, None]
        ratios = contrasts(power, weights, chosen.rows, streams, plan.quiet)
        layers = {}
        for number, stream in enumerate(streams):
            drive = Weights.at(int(self._rows[chosen.rows[number]]), chosen.weights[number])
            excitation = excitation_of(
                drive, self.table.eras, frequencies, gain=float(gains[number])
            )
            others = np.arange(len(streams)) != number
            for finger in stream.targets:
                felt = _as_decibels(ratios[finger]) if finger in ratios else (None, None, None)
                level = _as_decibels(
                    felt_amplitudes(power, weights, chosen.rows, number, (finger,))
                )
                heard = loudest_power(power[others], chosen.rows[others], finger)
                is_shared = finger != stream.targets[0]
                layers[finger] = Layer(
                    self.requests[finger],
                    excitation,
                    "shared" if is_shared else _verdict(felt[2]),
                    level_db_sl=level[0],
                    promised_level_db_sl=level[2],
                    felt_contrast_db=felt[0],
                    median_felt_contrast_db=felt[1],
                    promised_contrast_db=felt[2],
                    foreign_level_db_sl=_highest(heard) if others.any() else None,
                )
        quiet = {}
        for finger in plan.quiet:
            nominal, _, promised = _as_decibels(ratios[finger])
            highest = _highest(loudest_power(power, chosen.rows, finger))
            quiet[finger] = QuietFinger(self._every[finger].at, nominal, promised, highest)
        worst = _as_decibels(np.minimum.reduce([*ratios.values()]))[2] if ratios else None
        applied = () if chosen.is_apart else (f"frequencies are nearer than {self.apart_hz:g} Hz",)
        return _Measured(layers, quiet, worst, factor, applied)

    def _gains(self, streams: Sequence[Stream], chosen: Chosen) -> tuple[FloatArray, float]:
        """Gains (K,) to the levels at nine of ten plates, and the least factor within the stroke.

        The contents of each priority take one factor of what is left by the higher ones.
        """
        weights, gains = self._on_plate.tips.fine_weights, []
        for stream, power in zip(streams, chosen.power, strict=True):
            own = promise(own_amplitudes(power, weights, stream.targets))
            gains.append(10 ** (stream.level_db_sl / 20) / max(own, 1e-30))
        amplitudes = np.array(gains)[:, None] * np.abs(chosen.weights)
        priorities = [
            max(self.requests[finger].priority for finger in stream.targets) for stream in streams
        ]
        factors, left = np.zeros(len(streams)), np.ones(amplitudes.shape[1])
        for priority in sorted({*priorities}, reverse=True):
            of = np.array(priorities) == priority
            full = np.maximum(amplitudes[of].sum(axis=0), 1e-30)
            factors[of] = min(1.0, float((left / full).min()))
            left = np.maximum(left - factors[of] @ amplitudes[of], 0.0)
        return np.array(gains) * factors, float(factors.min())

    def _choose(self, streams: Sequence[Stream], quiet: Sequence[int]) -> Chosen:
        """The tones of all contents; of one for one finger as `LocalizationTable.query`."""
        table, (first, *others) = self.table, streams
        is_plain = len(first.targets) == len(first.rows) == 1
        if others or (quiet and not is_plain):  # alone it is weighed against the rest of the plate
            return choose_contents(
                self._on_plate,
                streams,
                quiet,
                table.frequencies[self._rows],
                apart_hz=self.apart_hz,
            )
        every = [self._every[finger] for finger in (*first.targets, *quiet)]
        count = len(first.targets)
        question = Question(
            tuple(each.at for each in every[:count]),
            tuple(each.at for each in every[count:]),
            level_db_sl=first.level_db_sl,
            drive_mode=UNRESTRICTED,
            frequencies=self.requests[first.targets[0]].band_hz,
            loads=tuple(each.load for each in every),
        )
        try:
            pattern = table.query(question)
        except UnreachableLevel as error:
            pattern = table.query(replace(question, level_db_sl=error.reachable_db_sl))
        frequencies, bases = base_amplitudes(pattern.excitation, table.eras)
        rows = np.searchsorted(table.frequencies[self._rows], frequencies)
        weights = (bases / [era.stroke for era in table.eras]).astype(np.complex64)
        return tones_chosen(self._on_plate, rows, weights)


def _worst_of(tried: tuple[_Plan, _Measured]) -> float:
    worst = tried[1].worst_db
    return math.inf if worst is None else worst


def _at(request: Request) -> str:
    return f"({request.at[0]:g}, {request.at[1]:g}) m"


def _as_decibels(ratio: Float32Array) -> tuple[float, float, float]:
    """Of ratios (1 + d,): as modelled, of half of the drawn plates, of nine of ten."""
    half, promised = promise(ratio, 50), promise(ratio)
    nominal, half, promised = decibels(np.array([ratio[0], half, promised])).tolist()
    return nominal, half, promised


def _highest(power: Float32Array) -> float:
    """Level [dB] of powers (1 + d,) that nine of ten drawn plates do not exceed."""
    return float(decibels(math.sqrt(promise(power, 100 - PROMISED_PERCENTILE))))


def _verdict(contrast_db: float | None) -> str:
    is_own = contrast_db is None or contrast_db >= OWN_CONTRAST_DB
    return "own" if is_own else "mixed"
