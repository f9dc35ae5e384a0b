"""More of the paper's idea: any number of ERAs, each silent or at a frequency of its own, exactly.

Four ERAs and 27 frequencies make 28^4 - 1 = 614 655 patterns. A pattern is a set of sources, each a
group of ERAs driven together at one frequency, no two at the same one; peak accelerations of its
sources add (paper Eq. 28). What the quiet points count as, their maximum or root mean square, is a
norm, so for any weights v >= 0 of dual norm 1 it is at least the sum of v times the sources' own
magnitudes. A pattern with contrast above c then needs

    sum over its sources of (target - c v . quiet) > 0,

a sum of one number for each source. The best v solve a linear program (or, for the root mean
square, least squares over x >= 0), whose value bounds what any mixture of sources could do, at any
amplitudes. Frequencies are enumerated only as far as the sum can still be above zero: of 614 655
patterns some hundred are left to be looked at.
"""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray, IntArray
from model.drive_modes.fields import SILENT, Drive, Fields, quietness
from model.drive_modes.mixture_bound import mixture_bound
from model.drive_modes.switched import find_switched
from model.errors import InputError

# What is enumerated at once; larger fronts are cut in pieces, one after the other.
FRONT = 100_000

# Of the quiet points a few decide; most patterns are seen by them not to be better.
DECISIVE_POINTS = 12

# Beyond this many ways to group ERAs the search would not end in a day.
MOST_ERAS = 9


@dataclass(frozen=True)
class ExactSearch:
    """What was found: the best drive, its contrast, and what no pattern can exceed (ratios).

    drive: None where no pattern reaches the level. is_complete: nothing was left out, so the drive
    is the best there is and bound its contrast; or else time ran out. mixture: the bound for
    mixtures of sources at any amplitudes. pattern_count: how many there are; looked_at: how many of
    them were not excluded by a bound.
    """

    drive: Drive | None
    contrast: float
    bound: float
    is_complete: bool
    mixture: float
    pattern_count: int
    looked_at: int


def search_exactly(
    fields: Fields, *, eras_at_most: int, time_limit: float = math.inf
) -> ExactSearch:
    """The pattern of highest contrast with up to so many ERAs that reaches the level.

    time_limit [s]: after it the best so far is given, with a bound. Raises InputError for more ERAs
    than can be searched.
    """
    if fields.era_count > MOST_ERAS:
        raise InputError(
            f"{fields.era_count} ERAs can be grouped in too many ways to search; {MOST_ERAS} are "
            "the most"
        )
    search = _Search(fields, eras_at_most, deadline=time.perf_counter() + time_limit)
    return search.run()


def loudest_found(fields: Fields, *, eras_at_most: int) -> float:
    """How many times above threshold up to so many ERAs can make the targets feel it.

    Of every grouping one pattern: group by group the frequency that the lesser target feels most,
    of those that are left. Reached for certain, and on a plate within 1.5 dB of the most there is.
    """
    masks = _masks(fields.era_count, eras_at_most)
    powers = [
        (_magnitudes(target, masks) / fields.threshold[:, None]) ** 2 for target in fields.targets
    ]
    means = np.array([power.mean(axis=-1) for power in powers])
    places = {mask: place for place, mask in enumerate(masks)}
    most = 0.0
    for groups in groupings(fields.era_count, eras_at_most):
        if len(groups) > fields.frequency_count:
            continue
        felt: list[FloatArray] = [np.zeros(power.shape[-1]) for power in powers]
        left = np.ones(fields.frequency_count, dtype=bool)
        for place in (places[mask] for mask in groups):
            so_far = np.array([each.mean() for each in felt])[:, None]
            frequency = int(np.where(left, (so_far + means[:, place]).min(axis=0), -1.0).argmax())
            left[frequency] = False
            felt = [
                each + power[place, frequency] for each, power in zip(felt, powers, strict=True)
            ]
        most = max(most, min(float(np.sqrt(each).mean()) for each in felt))
    return most


def pattern_count(era_count: int, frequency_count: int, *, eras_at_most: int) -> int:
    """How many patterns there are with 1 to `eras_at_most` ERAs."""
    return sum(
        math.comb(era_count, driven) * frequency_count**driven
        for driven in range(1, min(eras_at_most, era_count) + 1)
    )


@lru_cache(maxsize=8)
def groupings(era_count: int, eras_at_most: int) -> tuple[tuple[int, ...], ...]:
    """Every set of disjoint groups of ERAs, a group being a bit mask."""

    def extend(era: int, groups: tuple[int, ...], driven: int) -> Iterator[tuple[int, ...]]:
        if era == era_count:
            if groups:
                yield groups
            return
        yield from extend(era + 1, groups, driven)
        if driven == eras_at_most:
            return
        bit = 1 << era
        for number, group in enumerate(groups):
            joined = (*groups[:number], group | bit, *groups[number + 1 :])
            yield from extend(era + 1, joined, driven + 1)
        yield from extend(era + 1, (*groups, bit), driven + 1)

    return tuple(extend(0, (), 0))


def _masks(era_count: int, eras_at_most: int) -> list[int]:
    """Every group of so many ERAs at the most, as bit masks."""
    return [mask for mask in range(1, 1 << era_count) if mask.bit_count() <= eras_at_most]


def _magnitudes(field: NDArray[np.complex64], masks: Sequence[int]) -> FloatArray:
    """Magnitude of every group's sum, (groups, f, p), from each ERA's field (f, eras, p)."""
    f, eras, p = field.shape
    member = (np.array(masks)[:, None] >> np.arange(eras)) & 1
    flat = field.transpose(1, 0, 2).reshape(eras, -1)
    return np.asarray(np.abs(member.astype(complex) @ flat).reshape(-1, f, p))


class _Search:
    """One search; `contrast` and `drive` are the best so far."""

    def __init__(self, fields: Fields, eras_at_most: int, *, deadline: float) -> None:
        self._fields = fields
        self._deadline = deadline
        self._eras_at_most = eras_at_most
        self._masks = _masks(fields.era_count, eras_at_most)
        self._quiet = _magnitudes(fields.quiet, self._masks)
        self._targets = [_magnitudes(target, self._masks) for target in fields.targets]
        self._powers = [(target / fields.threshold[:, None]) ** 2 for target in self._targets]
        # By group and frequency. Of several targets the least is at most the mean.
        self._peak = np.mean([target.mean(axis=-1) for target in self._targets], axis=0)
        self._power = np.mean([power.mean(axis=-1) for power in self._powers], axis=0)
        share, self.mixture = self._dual_weights()
        self._loud = self._quiet @ share
        self._decisive = self._quiet[:, :, np.argsort(-share)[:DECISIVE_POINTS]]
        self.looked_at = 0
        self.contrast = 0.0
        self.drive: Drive | None = None

    def run(self) -> ExactSearch:
        """Start from what two ERAs can do, then go through the groupings, promising ones first."""
        if self._eras_at_most >= 2:
            self._start()
        places = {mask: place for place, mask in enumerate(self._masks)}
        left = [
            tuple(places[mask] for mask in groups)
            for groups in groupings(self._fields.era_count, self._eras_at_most)
        ]
        padded = np.full((len(left), self._fields.era_count), len(self._masks))
        for row, groups in enumerate(left):
            padded[row, : len(groups)] = groups
        bound = self.contrast
        order = np.argsort(-self._promise(padded))
        for done, row in enumerate(order):
            if self._promise(padded[row : row + 1])[0] > 0:
                self._enumerate(left[row])
            if time.perf_counter() > self._deadline:
                rest = padded[order[done:]]
                bound = self._mixture_of(rest[self._promise(rest) > 0])
                break
        fields = self._fields
        return ExactSearch(
            drive=self.drive,
            contrast=self.contrast,
            bound=max(self.contrast, bound),
            is_complete=bound <= self.contrast,
            mixture=self.mixture,
            pattern_count=pattern_count(
                fields.era_count, fields.frequency_count, eras_at_most=self._eras_at_most
            ),
            looked_at=self.looked_at,
        )

    def _dual_weights(self) -> tuple[FloatArray, float]:
        # Sources that no target feels cannot help.
        peak = np.maximum(self._peak.ravel(), 1e-12 * self._peak.max())
        relative = self._quiet.reshape(len(peak), -1) / peak[:, None]
        return mixture_bound(relative, is_rms=self._fields.is_alone)

    def _promise(self, groups: IntArray) -> FloatArray:
        """What the sums of groups (n, eras) of sources can be at the most, (n,); above 0 or out."""
        gain = np.append((self._peak - self.contrast * self._loud).max(axis=1), 0.0)
        power = np.append(self._power.max(axis=1), 0.0)
        reaches = power[groups].sum(axis=1) >= self._fields.wanted**2
        return np.where(reaches, gain[groups].sum(axis=1), -1.0)

    def _mixture_of(self, groups: IntArray) -> float:
        """The bound for mixtures of the sources in groups (n, eras) that are left."""
        if len(groups) == 0:
            return self.contrast
        ratio = np.append((self._peak / self._loud).max(axis=1), 0.0)
        return float(ratio[groups].max())

    def _enumerate(self, groups: tuple[int, ...]) -> None:
        """Go through the frequencies of groups, as far as the sum can be above zero."""
        chosen = np.empty((1, 0), dtype=int)
        self._descend(groups, chosen, np.zeros((1, 3)))

    def _descend(self, groups: tuple[int, ...], chosen: IntArray, sums: FloatArray) -> None:
        """Choose the next group's frequency for a front of choices so far (n, depth).

        sums (n, 3): of targets' peaks, of v . quiet, and of powers at the targets.
        """
        depth = chosen.shape[1]
        if depth == len(groups):
            self._look_at(groups, chosen, sums)
            return
        count = self._fields.frequency_count
        step = max(1, FRONT // count)
        for start in range(0, len(chosen), step):
            if time.perf_counter() > self._deadline:
                return
            rest = list(groups[depth + 1 :])
            gain = (self._peak[rest] - self.contrast * self._loud[rest]).max(axis=1).sum()
            power = self._power[rest].max(axis=1).sum()
            group = groups[depth]
            own = np.column_stack([self._peak[group], self._loud[group], self._power[group]])
            front = sums[start : start + step, None, :] + own
            promising = front[:, :, 0] - self.contrast * front[:, :, 1] + gain > 0
            promising &= front[:, :, 2] + power >= self._fields.wanted**2
            for earlier in range(depth):
                taken = chosen[start : start + step, earlier, None] == np.arange(count)
                promising &= ~taken
            row, frequency = np.nonzero(promising)
            if len(row):
                further = np.column_stack([chosen[start + row], frequency])
                self._descend(groups, further, front[row, frequency])

    def _look_at(self, groups: tuple[int, ...], chosen: IntArray, sums: FloatArray) -> None:
        """Judge choices (n, groups) in full and keep the best."""
        if not self._fields.is_alone:
            some = sum(
                self._decisive[group][chosen[:, column]] for column, group in enumerate(groups)
            )
            bounded = sums[:, 0] > self.contrast * np.asarray(some).max(axis=1)
            chosen = chosen[bounded]
        self.looked_at += len(chosen)
        for start in range(0, len(chosen), 4096):
            self._judge(groups, chosen[start : start + 4096])

    def _judge(self, groups: tuple[int, ...], chosen: IntArray) -> None:
        def total(rows: FloatArray) -> FloatArray:
            return np.asarray(
                sum(rows[group][chosen[:, column]] for column, group in enumerate(groups))
            )

        quiet = total(self._quiet)
        rms = self._fields.is_alone
        loud = np.sqrt((quiet**2).mean(axis=1)) if rms else quiet.max(axis=1)
        peak = np.min([total(target).mean(axis=1) for target in self._targets], axis=0)
        felt = np.min([np.sqrt(total(power)).mean(axis=1) for power in self._powers], axis=0)
        contrast = np.where(felt >= self._fields.wanted, peak / loud, 0.0)
        best = int(contrast.argmax())
        if contrast[best] > self.contrast:
            self.contrast = float(contrast[best])
            self.drive = self._drive(groups, chosen[best])

    def _drive(self, groups: tuple[int, ...], frequencies: IntArray) -> Drive:
        index = np.full(self._fields.era_count, SILENT)
        for group, frequency in zip(groups, frequencies, strict=True):
            for era in range(len(index)):
                if self._masks[group] >> era & 1:
                    index[era] = frequency
        return Drive(index, (index != SILENT).astype(np.complex64))

    def _start(self) -> None:
        """Take over the best of one or two ERAs, which is had at once."""
        drive = find_switched(self._fields, 0.0)
        if drive is None:
            return
        tones = drive.tones()
        peaks = [
            sum(np.abs(weight @ target[index]) for index, weight in tones)
            for target in self._fields.targets
        ]
        quiet = sum(np.abs(weight @ self._fields.quiet[index]) for index, weight in tones)
        peak = min(float(np.asarray(each).mean()) for each in peaks)
        self.drive = drive
        # A hair below what it is, lest rounding keep out its equals.
        self.contrast = peak / quietness(np.asarray(quiet), self._fields) * (1 - 1e-6)
