"""Exact search of the patterns in which any number of ERAs play, each at a frequency of its own.

Four ERAs and 27 frequencies make 28^4 - 1 = 614 655 patterns. A pattern is a set of sources, each a
group of ERAs at one frequency, no two groups at the same one; the expected powers of its sources,
each over the squared threshold, add. The maximum over the quiet fingertips is at least v . quiet
for any weights v >= 0 of sum 1 (`model.drive_modes.dual_weights`), so that a pattern of a power
ratio above c needs

    sum over its sources of (target - c v . quiet) > 0.

Frequencies are enumerated only while that sum can still be above zero: of 614 655 patterns some
hundred are left to evaluate.
"""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray, IntArray
from model.choice import NEARLY, best_first, best_of
from model.drive_modes.dual_weights import dual_weights
from model.drive_modes.forms import SILENT, Forms, Weights
from model.drive_modes.switched import find_switched, source_powers
from model.errors import InputError

MAX_FRONT = 100_000
"""Choices of frequencies that are extended at once."""

MAX_ERAS = 9
"""Maximum number of ERAs; with more the search would not end in a day."""


@dataclass(frozen=True)
class ExactResult:
    """The best drive, its robust score, and a bound of any pattern's (ratios of amplitudes).

    drive: None where no pattern reaches the level. is_complete: the drive is proven to be the best
    and bound is its score; else the time ran out. pattern_count: number of patterns;
    evaluated_count: of those that no bound excluded.
    """

    drive: Weights | None
    score: float
    bound: float
    is_complete: bool
    pattern_count: int
    evaluated_count: int


def search_exactly(forms: Forms, *, eras_at_most: int, time_limit: float = math.inf) -> ExactResult:
    """Find the pattern of best score with at most `eras_at_most` ERAs that reaches the level.

    time_limit [s]: after it the best so far is returned, with a bound. Raises InputError for more
    than MAX_ERAS.
    """
    if forms.era_count > MAX_ERAS:
        raise InputError(
            f"exact search: ERAs must be at most {MAX_ERAS}, got {forms.era_count}; with more "
            "there are too many groupings"
        )
    search = _Search(forms, eras_at_most, deadline=time.perf_counter() + time_limit)
    return search.run()


def sensation_found(forms: Forms, *, eras_at_most: int) -> float:
    """Greedy lower bound of the sensation (amplitude to threshold) at the weakest target.

    With at most `eras_at_most` ERAs. The best of one pattern for each grouping: group by group the
    unused frequency of the highest sensation at the weakest target. On a plate it is within 1.5 dB
    of the true maximum.
    """
    masks = group_masks(forms.era_count, eras_at_most)
    powers = source_powers(forms, _members(masks, forms.era_count)).target
    places = {mask: place for place, mask in enumerate(masks)}
    highest = 0.0
    for groups in groupings(forms.era_count, eras_at_most):
        if len(groups) > forms.frequency_count:
            continue
        power_sums = np.zeros(len(powers))
        left = np.ones(forms.frequency_count, dtype=bool)
        for place in (places[mask] for mask in groups):
            reached = (power_sums[:, None] + powers[:, place]).min(axis=0)
            frequency = best_of(np.where(left, reached, -1.0))
            left[frequency] = False
            power_sums = power_sums + powers[:, place, frequency]
        highest = max(highest, math.sqrt(float(power_sums.min())))
    return highest


def pattern_count(era_count: int, frequency_count: int, *, eras_at_most: int) -> int:
    """Number of patterns with 1 to `eras_at_most` ERAs."""
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


def group_masks(era_count: int, eras_at_most: int) -> list[int]:
    """Every group of at most `eras_at_most` ERAs, as bit masks."""
    return [mask for mask in range(1, 1 << era_count) if mask.bit_count() <= eras_at_most]


def _members(masks: Sequence[int], eras: int) -> NDArray[np.float32]:
    """Membership (groups, eras) of groups that are bit masks."""
    return ((np.array(masks)[:, None] >> np.arange(eras)) & 1).astype(np.float32)


class _Search:
    """One search; `ratio` (of powers) and `drive` are the best so far."""

    def __init__(self, forms: Forms, eras_at_most: int, *, deadline: float) -> None:
        self._forms = forms
        self._deadline = deadline
        self._eras_at_most = eras_at_most
        self._masks = group_masks(forms.era_count, eras_at_most)
        powers = source_powers(forms, _members(self._masks, forms.era_count))
        # By group and frequency. The weakest of several targets is at most their mean.
        self._targets = powers.target.astype(float)
        self._variance = powers.variance.astype(float)
        self._quiet = np.moveaxis(powers.quiet.astype(float), 0, -1)
        self._power = self._targets.mean(axis=0)
        flat = self._quiet.reshape(self._power.size, -1)
        self._loud = self._quiet @ dual_weights(self._power.ravel(), flat)
        self.evaluated_count = 0
        self.ratio = 0.0
        self.drive: Weights | None = None

    def run(self) -> ExactResult:
        """Start from the best of two ERAs, then enumerate the groupings, largest bound first."""
        if self._eras_at_most >= 2:
            self._start()
        places = {mask: place for place, mask in enumerate(self._masks)}
        left = [
            tuple(places[mask] for mask in groups)
            for groups in groupings(self._forms.era_count, self._eras_at_most)
        ]
        padded = np.full((len(left), self._forms.era_count), len(self._masks))
        for row, groups in enumerate(left):
            padded[row, : len(groups)] = groups
        bound = self.ratio
        order = best_first(self._gain_bound(padded))
        for done, row in enumerate(order):
            if self._gain_bound(padded[row : row + 1])[0] > 0:
                self._enumerate(left[row])
            if time.perf_counter() > self._deadline:
                rest = padded[order[done:]]
                bound = self._ratio_bound(rest[self._gain_bound(rest) > 0])
                break
        forms = self._forms
        return ExactResult(
            drive=self.drive,
            score=math.sqrt(self.ratio),
            bound=math.sqrt(max(self.ratio, bound)),
            is_complete=bound <= self.ratio,
            pattern_count=pattern_count(
                forms.era_count, forms.frequency_count, eras_at_most=self._eras_at_most
            ),
            evaluated_count=self.evaluated_count,
        )

    def _gain_bound(self, groups: IntArray) -> FloatArray:
        """Upper bound of the sum over groups (n, eras), (n,); a better pattern needs > 0."""
        gain = np.append((self._power - self.ratio * self._loud).max(axis=1), 0.0)
        power = np.append(self._power.max(axis=1), 0.0)
        reaches = power[groups].sum(axis=1) >= self._forms.wanted**2
        return np.where(reaches, gain[groups].sum(axis=1), -1.0)

    def _ratio_bound(self, groups: IntArray) -> float:
        """Bound of the power ratio of any pattern of groups (n, eras)."""
        if len(groups) == 0:
            return self.ratio
        ratio = np.append((self._power / self._loud).max(axis=1), 0.0)
        return float(ratio[groups].max())

    def _enumerate(self, groups: tuple[int, ...]) -> None:
        """Enumerate the frequencies of groups while the sum can be above zero."""
        chosen = np.empty((1, 0), dtype=int)
        self._descend(groups, chosen, np.zeros((1, 2)))

    def _descend(self, groups: tuple[int, ...], chosen: IntArray, sums: FloatArray) -> None:
        """Extend choices (n, depth) of frequencies by that of the next group.

        sums (n, 2): of powers at the targets, and of v . quiet.
        """
        depth = chosen.shape[1]
        if depth == len(groups):
            self.evaluated_count += len(chosen)
            for start in range(0, len(chosen), 4096):
                self._keep_best(groups, chosen[start : start + 4096])
            return
        count = self._forms.frequency_count
        step = max(1, MAX_FRONT // count)
        for start in range(0, len(chosen), step):
            if time.perf_counter() > self._deadline:
                return
            rest = list(groups[depth + 1 :])
            gain = (self._power[rest] - self.ratio * self._loud[rest]).max(axis=1).sum()
            power = self._power[rest].max(axis=1).sum()
            group = groups[depth]
            own = np.column_stack([self._power[group], self._loud[group]])
            front = sums[start : start + step, None, :] + own
            is_possible = front[:, :, 0] - self.ratio * front[:, :, 1] + gain > 0
            is_possible &= front[:, :, 0] + power >= self._forms.wanted**2
            for earlier in range(depth):
                taken = chosen[start : start + step, earlier, None] == np.arange(count)
                is_possible &= ~taken
            row, frequency = np.nonzero(is_possible)
            if len(row):
                further = np.column_stack([chosen[start + row], frequency])
                self._descend(groups, further, front[row, frequency])

    def _keep_best(self, groups: tuple[int, ...], chosen: IntArray) -> None:
        def total(rows: FloatArray) -> FloatArray:
            return np.asarray(
                sum(rows[group][chosen[:, column]] for column, group in enumerate(groups))
            )

        loud = total(self._quiet).max(axis=1)
        powers = np.array([total(target) for target in self._targets])
        variance = np.array([total(each) for each in self._variance])
        reached = np.sqrt(powers) - self._forms.level_margin * np.sqrt(variance)
        reaches = (reached >= self._forms.wanted).all(axis=0)
        ratio = np.where(reaches, powers.min(axis=0) / loud, 0.0)
        best = best_of(ratio)
        if ratio[best] > (1 + NEARLY) * self.ratio:
            self.ratio = float(ratio[best])
            self.drive = self._drive(groups, chosen[best])

    def _drive(self, groups: tuple[int, ...], frequencies: IntArray) -> Weights:
        index = np.full(self._forms.era_count, SILENT)
        for group, frequency in zip(groups, frequencies, strict=True):
            for era in range(len(index)):
                if self._masks[group] >> era & 1:
                    index[era] = frequency
        return Weights(index, (index != SILENT).astype(np.complex64))

    def _start(self) -> None:
        """Take the best drive of one or two ERAs as the first."""
        found = find_switched(self._forms, 0.0)
        if found:
            score, self.drive = found[0]
            # Slightly less, so that rounding does not exclude patterns of the same score.
            self.ratio = score**2 * (1 - 1e-6)
