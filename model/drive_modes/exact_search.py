"""Exact search of the patterns in which any number of ERAs play, each at a frequency of its own.

Four ERAs and 27 frequencies make 28^4 - 1 = 614 655 patterns. A pattern is a set of sources, each a
group of ERAs at one frequency, no two groups at the same one; peak accelerations of its sources add
(paper Eq. 28). The norm of the quiet points is at least v . quiet for any weights v >= 0 of dual
norm 1 (`model.drive_modes.dual_weights`), so that a pattern of contrast above c needs

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
from model.drive_modes.dual_weights import dual_weights
from model.drive_modes.fields import SILENT, Fields, Weights, quiet_amplitude
from model.drive_modes.switched import find_switched
from model.errors import InputError

MAX_FRONT = 100_000
"""Choices of frequencies that are extended at once."""

DECISIVE_POINTS = 12
"""Quiet points of the largest weights, by which most patterns are excluded."""

MAX_ERAS = 9
"""Maximum number of ERAs; with more the search would not end in a day."""


@dataclass(frozen=True)
class ExactResult:
    """The best drive, its contrast, and a bound of any pattern's contrast (ratios).

    drive: None where no pattern reaches the level. is_complete: the drive is proven to be the best
    and bound is its contrast; else the time ran out. pattern_count: number of patterns;
    evaluated_count: of those that no bound excluded.
    """

    drive: Weights | None
    contrast: float
    bound: float
    is_complete: bool
    pattern_count: int
    evaluated_count: int


def search_exactly(
    fields: Fields, *, eras_at_most: int, time_limit: float = math.inf
) -> ExactResult:
    """Find the pattern of highest contrast with at most `eras_at_most` ERAs that reaches the level.

    time_limit [s]: after it the best so far is returned, with a bound. Raises InputError for more
    than MAX_ERAS.
    """
    if fields.era_count > MAX_ERAS:
        raise InputError(
            f"exact search: ERAs must be at most {MAX_ERAS}, got {fields.era_count}; with more "
            "there are too many groupings"
        )
    search = _Search(fields, eras_at_most, deadline=time.perf_counter() + time_limit)
    return search.run()


def sensation_found(fields: Fields, *, eras_at_most: int) -> float:
    """Greedy lower bound of the sensation (amplitude to threshold) at the weakest target.

    With at most `eras_at_most` ERAs. The best of one pattern for each grouping: group by group the
    unused frequency of the highest sensation at the weakest target. On a plate it is within 1.5 dB
    of the true maximum.
    """
    masks = group_masks(fields.era_count, eras_at_most)
    powers = [
        (group_magnitudes(target, masks) / fields.threshold[:, None]) ** 2
        for target in fields.targets
    ]
    means = np.array([power.mean(axis=-1) for power in powers])
    places = {mask: place for place, mask in enumerate(masks)}
    highest = 0.0
    for groups in groupings(fields.era_count, eras_at_most):
        if len(groups) > fields.frequency_count:
            continue
        power_sums: list[FloatArray] = [np.zeros(power.shape[-1]) for power in powers]
        left = np.ones(fields.frequency_count, dtype=bool)
        for place in (places[mask] for mask in groups):
            so_far = np.array([each.mean() for each in power_sums])[:, None]
            frequency = int(np.where(left, (so_far + means[:, place]).min(axis=0), -1.0).argmax())
            left[frequency] = False
            power_sums = [
                each + power[place, frequency]
                for each, power in zip(power_sums, powers, strict=True)
            ]
        highest = max(highest, min(float(np.sqrt(each).mean()) for each in power_sums))
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


def group_magnitudes(field: NDArray[np.complex64], masks: Sequence[int]) -> FloatArray:
    """Magnitude of every group's sum, (groups, f, p), from each ERA's field (f, eras, p)."""
    f, eras, p = field.shape
    member = (np.array(masks)[:, None] >> np.arange(eras)) & 1
    flat = field.transpose(1, 0, 2).reshape(eras, -1)
    return np.asarray(np.abs(member.astype(complex) @ flat).reshape(-1, f, p))


def mean_target_peak(targets: Sequence[FloatArray]) -> FloatArray:
    """Peak of each source, mean over targets' points and targets: (groups, f) of (groups, f, p)."""
    return np.asarray(np.mean([target.mean(axis=-1) for target in targets], axis=0))


class _Search:
    """One search; `contrast` and `drive` are the best so far."""

    def __init__(self, fields: Fields, eras_at_most: int, *, deadline: float) -> None:
        self._fields = fields
        self._deadline = deadline
        self._eras_at_most = eras_at_most
        self._masks = group_masks(fields.era_count, eras_at_most)
        self._quiet = group_magnitudes(fields.quiet, self._masks)
        self._targets = [group_magnitudes(target, self._masks) for target in fields.targets]
        self._powers = [(target / fields.threshold[:, None]) ** 2 for target in self._targets]
        # By group and frequency. The weakest of several targets is at most their mean.
        self._peak = mean_target_peak(self._targets)
        self._power = mean_target_peak(self._powers)
        flat = self._quiet.reshape(self._peak.size, -1)
        weights = dual_weights(self._peak.ravel(), flat, is_rms=fields.has_no_quiet_contacts)
        self._loud = self._quiet @ weights
        self._decisive = self._quiet[:, :, np.argsort(-weights)[:DECISIVE_POINTS]]
        self.evaluated_count = 0
        self.contrast = 0.0
        self.drive: Weights | None = None

    def run(self) -> ExactResult:
        """Start from the best of two ERAs, then enumerate the groupings, largest bound first."""
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
        order = np.argsort(-self._gain_bound(padded))
        for done, row in enumerate(order):
            if self._gain_bound(padded[row : row + 1])[0] > 0:
                self._enumerate(left[row])
            if time.perf_counter() > self._deadline:
                rest = padded[order[done:]]
                bound = self._ratio_bound(rest[self._gain_bound(rest) > 0])
                break
        fields = self._fields
        return ExactResult(
            drive=self.drive,
            contrast=self.contrast,
            bound=max(self.contrast, bound),
            is_complete=bound <= self.contrast,
            pattern_count=pattern_count(
                fields.era_count, fields.frequency_count, eras_at_most=self._eras_at_most
            ),
            evaluated_count=self.evaluated_count,
        )

    def _gain_bound(self, groups: IntArray) -> FloatArray:
        """Upper bound of the sum over groups (n, eras), (n,); a better pattern needs > 0."""
        gain = np.append((self._peak - self.contrast * self._loud).max(axis=1), 0.0)
        power = np.append(self._power.max(axis=1), 0.0)
        reaches = power[groups].sum(axis=1) >= self._fields.wanted**2
        return np.where(reaches, gain[groups].sum(axis=1), -1.0)

    def _ratio_bound(self, groups: IntArray) -> float:
        """Bound of the contrast of any pattern of groups (n, eras)."""
        if len(groups) == 0:
            return self.contrast
        ratio = np.append((self._peak / self._loud).max(axis=1), 0.0)
        return float(ratio[groups].max())

    def _enumerate(self, groups: tuple[int, ...]) -> None:
        """Enumerate the frequencies of groups while the sum can be above zero."""
        chosen = np.empty((1, 0), dtype=int)
        self._descend(groups, chosen, np.zeros((1, 3)))

    def _descend(self, groups: tuple[int, ...], chosen: IntArray, sums: FloatArray) -> None:
        """Extend choices (n, depth) of frequencies by that of the next group.

        sums (n, 3): of targets' peaks, of v . quiet, and of powers at the targets.
        """
        depth = chosen.shape[1]
        if depth == len(groups):
            self._screen(groups, chosen, sums)
            return
        count = self._fields.frequency_count
        step = max(1, MAX_FRONT // count)
        for start in range(0, len(chosen), step):
            if time.perf_counter() > self._deadline:
                return
            rest = list(groups[depth + 1 :])
            gain = (self._peak[rest] - self.contrast * self._loud[rest]).max(axis=1).sum()
            power = self._power[rest].max(axis=1).sum()
            group = groups[depth]
            own = np.column_stack([self._peak[group], self._loud[group], self._power[group]])
            front = sums[start : start + step, None, :] + own
            is_possible = front[:, :, 0] - self.contrast * front[:, :, 1] + gain > 0
            is_possible &= front[:, :, 2] + power >= self._fields.wanted**2
            for earlier in range(depth):
                taken = chosen[start : start + step, earlier, None] == np.arange(count)
                is_possible &= ~taken
            row, frequency = np.nonzero(is_possible)
            if len(row):
                further = np.column_stack([chosen[start + row], frequency])
                self._descend(groups, further, front[row, frequency])

    def _screen(self, groups: tuple[int, ...], chosen: IntArray, sums: FloatArray) -> None:
        """Evaluate choices (n, groups) that the decisive points do not exclude."""
        if not self._fields.has_no_quiet_contacts:
            some = sum(
                self._decisive[group][chosen[:, column]] for column, group in enumerate(groups)
            )
            bounded = sums[:, 0] > self.contrast * np.asarray(some).max(axis=1)
            chosen = chosen[bounded]
        self.evaluated_count += len(chosen)
        for start in range(0, len(chosen), 4096):
            self._keep_best(groups, chosen[start : start + 4096])

    def _keep_best(self, groups: tuple[int, ...], chosen: IntArray) -> None:
        def total(rows: FloatArray) -> FloatArray:
            return np.asarray(
                sum(rows[group][chosen[:, column]] for column, group in enumerate(groups))
            )

        quiet = total(self._quiet)
        rms = self._fields.has_no_quiet_contacts
        loud = np.sqrt((quiet**2).mean(axis=1)) if rms else quiet.max(axis=1)
        peak = np.min([total(target).mean(axis=1) for target in self._targets], axis=0)
        sensation = np.min([np.sqrt(total(power)).mean(axis=1) for power in self._powers], axis=0)
        contrast = np.where(sensation >= self._fields.wanted, peak / loud, 0.0)
        best = int(contrast.argmax())
        if contrast[best] > self.contrast:
            self.contrast = float(contrast[best])
            self.drive = self._drive(groups, chosen[best])

    def _drive(self, groups: tuple[int, ...], frequencies: IntArray) -> Weights:
        index = np.full(self._fields.era_count, SILENT)
        for group, frequency in zip(groups, frequencies, strict=True):
            for era in range(len(index)):
                if self._masks[group] >> era & 1:
                    index[era] = frequency
        return Weights(index, (index != SILENT).astype(np.complex64))

    def _start(self) -> None:
        """Take the best drive of one or two ERAs as the first."""
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
        # Slightly less, so that rounding does not exclude patterns of the same contrast.
        self.contrast = peak / quiet_amplitude(np.asarray(quiet), self._fields) * (1 - 1e-6)
