"""Search for the tones of contents, in C if the kernel supports the question, else in numpy.

`choose_by_numpy` is the reference for the kernel. It handles questions that the kernel does not
support (durations, envelopes, avoided frequencies, the drive mode `switched`), and computers
without the kernel. `_SEARCHES` finds candidates for each content, drawn plates decide
between them, and the best combination is promised.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from model.answer.answer import OWN_CONTRAST_DB, SAME_LEVEL
from model.answer.fingers_on_plate import (
    CENTER_AND_FOUR,
    MAX_FINGERS_BY_POINT,
    DriveTones,
    FingerForms,
    FingersOnPlate,
)
from model.answer.kernel_question import ask_kernel, is_for_kernel
from model.answer.promise import promised
from model.answer.question import KEPT, MISSING, PRUNING_STEP, REACHED, Contents, Stream, Tones
from model.answer.ringing import RingingUnderFingers, on_drawn_plates
from model.arrays import (
    Float32Array,
    FloatArray,
    IntArray,
    best_few,
    best_first,
    best_of,
)
from model.compiled.kernels import kernels
from model.drive_forms import Forms, WeightedTones
from model.drive_modes import UNRESTRICTED
from model.ensemble.draws import JUDGING_DRAWS, percentile
from model.finger import decibels
from model.phased_weights import (
    NEARLY_HIGHEST,
    CoherentResult,
    search,
    search_all,
    search_to_level,
)
from model.switched_patterns import ALTERNATIVES, find_switched, max_sensation_switched
from model.table.record import SAME_FREQUENCY
from model.table.table import LocalizationTable

MAX_BY_POINT = 8
"""Frequencies at which weights over a duration are also searched with the points of fingertips."""

IN_TIME = 3
"""Number of pulse candidates solved in time, the best by energy."""

FEW_ROWS = 8
"""Largest number of frequencies at which a phased answer is compared with switched patterns.

With more, no pattern promised more in 960 questions; comparing takes as long as answering.
"""

# Smaller values count as these, so that nothing is divided by zero.
_LEAST_POWER = 1e-20
_LEAST_LEVEL = 1e-20
_LEAST_AMPLITUDE = 1e-30

_NEVER_CHOSEN = 1e12
"""Power at all fingers of candidates that are not solved in time: 120 dB above the threshold.

It is finite, since contrasts of such candidates are still computed and compared.
"""

_BATCH = 64  # candidates evaluated together


def choose_tones(table: LocalizationTable, contents: Contents) -> Tones:
    """Choose tones for each content and compute their promises.

    A promise of the drive mode `phased` is at least that of `switched` patterns at one frequency.
    """
    library = kernels()
    has_kernel = library is not None
    if library is not None and is_for_kernel(contents):
        tones = ask_kernel(library, table, contents)
    else:
        tones = choose_by_numpy(table, contents, fingers_by_kernel=has_kernel)
    if not _could_be_switched(contents, tones):
        return tones
    switched = _choose_switched(table, contents, fingers_by_kernel=has_kernel)
    if switched is None or not _is_better(switched, tones, contents.streams[0]):
        return tones
    return switched


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A drive that a content can use."""

    content: int
    band: int
    """Number of the band within its content."""
    score: float
    drive: WeightedTones


@dataclass(frozen=True, eq=False)
class _Candidates:
    """m candidates of all contents."""

    contents: IntArray
    """Content of each (m,)."""
    bands: IntArray
    """Band of each candidate (m,), by number within its content."""
    scores: FloatArray
    drives: Sequence[WeightedTones]

    @classmethod
    def of(cls, candidates: Sequence[_Candidate]) -> "_Candidates":
        """Join candidates, in order."""
        return cls(
            contents=np.array([candidate.content for candidate in candidates]),
            bands=np.array([candidate.band for candidate in candidates]),
            scores=np.array([candidate.score for candidate in candidates]),
            drives=[candidate.drive for candidate in candidates],
        )

    @property
    def rows(self) -> IntArray:
        """Row of the first tone of each candidate (m,)."""
        return np.array([drive[0][0] for drive in self.drives], dtype=int)


@dataclass(frozen=True, eq=False)
class _Judgment:
    """Levels of m candidates on d drawn plates.

    Scaled to the contents' levels if there are several contents.
    """

    least: FloatArray
    """Level (m,) that 90 % of plates reach, as an amplitude; nominal over a duration."""
    own: FloatArray
    """Amplitude (m, d) at the targets."""
    loudest: FloatArray
    """Squared amplitude (m, k, d) at the loudest points of all fingers."""


def choose_by_numpy(
    table: LocalizationTable, contents: Contents, *, fingers_by_kernel: bool = False
) -> Tones:
    """Choose tones for each content and compute their promises, in numpy.

    fingers_by_kernel: whether to solve the plate under the fingers in C; the search itself never
    uses the kernel.
    """
    fingers = FingersOnPlate.of(table, contents.places, contents.loads, by_kernel=fingers_by_kernel)
    ringing = RingingUnderFingers.of_streams(table, contents)
    candidates = _SEARCHES[contents.drive_mode](fingers, contents, ringing)
    return _best_tones(fingers, contents, candidates, ringing)


def _best_tones(
    fingers: FingersOnPlate,
    contents: Contents,
    candidates: _Candidates,
    ringing: Sequence[RingingUnderFingers | None],
) -> Tones:
    """Choose among candidates on drawn plates, and compute the promises."""
    table = fingers.table
    judgment = _judged(fingers, contents, candidates, ringing)
    best = np.zeros(1, dtype=int)
    is_apart = True
    if len(contents.streams) > 1:
        best, is_apart = best_combination(table, contents, candidates, judgment)
    elif len(candidates.drives) > 1:
        best[0] = best_tone(contents, candidates.scores, judgment)
    tones = DriveTones.of([candidates.drives[number] for number in best.tolist()])
    return promised(fingers, contents, tones, is_apart=is_apart, ringing=ringing)


def _could_be_switched(contents: Contents, tones: Tones) -> bool:
    """Return whether a switched pattern could promise more than phased tones."""
    is_single = len(contents.streams) == 1 and bool(contents.quiet)
    is_phased = contents.drive_mode == UNRESTRICTED
    is_weak = tones.worst_db < OWN_CONTRAST_DB
    return is_single and is_phased and is_weak and len(contents.rows) <= FEW_ROWS


def _choose_switched(
    table: LocalizationTable, contents: Contents, *, fingers_by_kernel: bool
) -> Tones | None:
    """Choose the best switched pattern at one frequency, and promise it; None if there is none."""
    fingers = FingersOnPlate.of(table, contents.places, contents.loads, by_kernel=fingers_by_kernel)
    ringing = RingingUnderFingers.of_streams(table, contents)
    rows, forms = _switched_forms(fingers, contents, ringing)
    candidates = list[_Candidate]()
    for place in range(len(rows)):
        at_row = forms.at(np.array([place]))
        candidates += _pattern_candidates(at_row, rows[[place]], _groups(table))
    if not candidates:
        return None
    candidates.sort(key=attrgetter("score"), reverse=True)
    best_candidates = _Candidates.of(candidates[:ALTERNATIVES])
    return _best_tones(fingers, contents, best_candidates, ringing)


def _is_better(tones: Tones, other: Tones, stream: Stream) -> bool:
    """Return whether tones promise a content more contrast than others, and no lower level."""
    levels = [tones.level_db_sl[finger][1] for finger in stream.targets]
    other_levels = [other.level_db_sl[finger][1] for finger in stream.targets]
    is_as_loud = min(levels) >= min(other_levels) - SAME_LEVEL
    return is_as_loud and tones.worst_db > other.worst_db


def _coherent_candidates(
    fingers: FingersOnPlate,
    contents: Contents,
    ringing: Sequence[RingingUnderFingers | None],
) -> _Candidates:
    """Find the best tones of each content among the most promising rows, or among all."""
    rows = contents.rows
    if contents.is_ranked and not any(ringing) and not fingers.table.clocks.groups:
        ranked_rows = ranked(fingers, contents)
        candidates, is_limited = _candidates_at(fingers, contents, ranked_rows, ringing)
        is_enough = len(candidates.drives) > 0 and not is_limited
        if is_enough or len(ranked_rows) == len(rows):
            return candidates
    candidates, _ = _candidates_at(fingers, contents, rows, ringing)
    return candidates


def ranked(fingers: FingersOnPlate, contents: Contents) -> IntArray:
    """Return the most promising rows for a single target, ascending.

    Based on one form of all other fingers together.
    """
    table = fingers.table
    touched = fingers.touched
    rows = contents.rows
    target = contents.streams[0].targets[0]
    others = contents.others(0)
    points = fingers.tips.few
    weights = fingers.tips.few_weights
    touch_steps = fingers.tips.touch_steps
    if len(others) > MAX_FINGERS_BY_POINT:
        points = touched.centers[:, None]
        weights = np.ones_like(weights[:, :1])
        touch_steps = None
    shares = np.zeros_like(weights)
    shares[others] = weights[others] / np.float32(len(others))
    contacts = touched.forms(
        rows,
        points.reshape(1, -1, points.shape[2]),
        shares.reshape(1, -1),
        table.search_error_power,
        touch_steps=touch_steps,
    )
    fields = contacts.fields.reshape(len(rows), *points.shape[:2], -1)
    mean = (weights[target] @ fields[:, target])[None]
    forms = Forms(
        targets=mean,
        target_power=contacts.power.swapaxes(0, 1),
        quiet=contacts.power,
        threshold=table.thresholds.take(rows),
        wanted=float(contents.levels[0]),
        level_margin=0.0,
    )
    result = search_all(forms)
    order = best_first(result.bound)
    reaches = result.score[order] > 0
    # Rows that would beat the best one if they were loud enough.
    first_reaching = int(reaches.argmax()) if reaches.any() else len(order)
    missing = order[:first_reaching][:MISSING]
    reaching = order[reaches][: KEPT - len(missing)]
    best_places = np.sort(np.concatenate([reaching, missing]))
    return np.asarray(rows[best_places])


@dataclass(frozen=True, eq=False)
class _SearchResult:
    """The best weights for a content at some of the solved rows."""

    places: IntArray
    """Indices of the rows among the solved rows."""
    result: CoherentResult
    is_limited: bool
    """Whether the level was hard to reach."""


@dataclass(frozen=True, eq=False)
class _ContentSearch:
    """Search for the tones of a content at the solved rows."""

    finger_forms: FingerForms
    steady: Forms
    """Forms of its steady level at all solved rows."""
    others: Sequence[int]
    """Fingers from which the content is kept."""
    ringing: RingingUnderFingers | None
    """None for a continuous content, or without other fingers that ringing could disturb."""

    def results(
        self, places: IntArray, groups: Sequence[NDArray[np.bool_]]
    ) -> Iterator[_SearchResult]:
        """Search with each group of ERAs, for the mean over quiet fingers and for their points.

        If any group reaches the level, only groups that reach it count.
        """
        forms = _forms_at(places, self.steady, self.ringing)
        by_group = list[tuple[Forms, _SearchResult]]()
        reaching = list[tuple[Forms, _SearchResult]]()
        for group in groups:
            group_forms = forms.among(group)
            result, searched_forms = search_to_level(group_forms)
            is_lowered = searched_forms is not group_forms
            is_limited = is_lowered or len(result.level_limited) > 0
            by_group.append((searched_forms, _SearchResult(places, result, is_limited)))
            if not is_lowered:
                reaching.append(by_group[-1])
        for searched_forms, by_mean in reaching or by_group:
            yield by_mean
            if 1 <= len(self.others) <= MAX_FINGERS_BY_POINT and by_mean.result.score.any():
                yield self._by_point(by_mean, searched_forms)

    def _by_point(self, by_mean: _SearchResult, searched_forms: Forms) -> _SearchResult:
        """Search for the points of quiet fingers, at the level that the search for means used."""
        places = by_mean.places
        if self.ringing is not None:
            best = best_first(by_mean.result.score)[:MAX_BY_POINT]
            places = places[np.sort(best)]
        steady = replace(
            self.steady,
            wanted=searched_forms.wanted,
            driven=searched_forms.driven,
            level_margin=searched_forms.level_margin,
        )
        steady_by_point = self.finger_forms.by_point(steady, self.others)
        forms = _forms_at(places, steady_by_point, self.ringing)
        return _SearchResult(places, search(forms), by_mean.is_limited)


def _candidates_at(
    fingers: FingersOnPlate,
    contents: Contents,
    rows: IntArray,
    ringing: Sequence[RingingUnderFingers | None],
) -> tuple[_Candidates, bool]:
    """Find the best tones of each content in each band, and whether a level was hard to reach.

    With all ERAs together, or with each group of ERAs on a common clock.

    K contents share the stroke of the ERAs. The level of each is raised by 20 log10(K) dB: drives
    that reach K times its amplitude at full stroke need at most a K-th of every ERA's stroke at its
    own amplitude, so that all contents fit together.
    """
    content_count = len(contents.streams)
    frequencies = fingers.table.frequencies
    groups = _groups(fingers.table)
    solved_rows = np.arange(len(frequencies)) if any(ringing) else rows
    finger_forms = fingers.forms(solved_rows, with_fine=True)
    apart_hz = contents.apart_hz if content_count > 1 else 0.0
    candidates = list[_Candidate]()
    is_limited = False
    for number, stream in enumerate(contents.streams):
        others = contents.others(number)
        content_ringing = ringing[number] if others else None
        level_db_sl = stream.level_db_sl + float(decibels(content_count))
        rest_of_plate = None
        if contents.background is not None and not others:
            rest_of_plate = contents.background[solved_rows]
        steady = finger_forms.of(stream.targets, others, level_db_sl, rest_of_plate)
        content_search = _ContentSearch(finger_forms, steady, others, content_ringing)
        for band, (low, end) in enumerate(stream.bands):
            is_in_band = (solved_rows >= low) & (solved_rows < end)
            places = np.flatnonzero(np.isin(solved_rows, rows) & is_in_band)
            if content_ringing is not None:
                places = content_ringing.lasting_long_enough(places)
            for search_result in content_search.results(places, groups):
                is_limited |= search_result.is_limited
                tone_rows = solved_rows[search_result.places]
                scores = search_result.result.score
                chosen = _apart(scores, frequencies[tone_rows], contents.candidates, apart_hz)
                for index in chosen:
                    weights = search_result.result.weights[index]
                    candidates.append(
                        _Candidate(
                            content=number,
                            band=band,
                            score=float(scores[index]),
                            drive=[(int(tone_rows[index]), weights)],
                        )
                    )
    return _Candidates.of(candidates), is_limited


def _switched_candidates(
    fingers: FingersOnPlate,
    contents: Contents,
    ringing: Sequence[RingingUnderFingers | None],
) -> _Candidates:
    """Find the best patterns of the drive mode `switched` for a single content.

    Uses the ERAs of a single group at a time; near the highest level if no group reaches the
    requested level.
    """
    rows, forms = _switched_forms(fingers, contents, ringing)
    candidates = _pattern_candidates(forms, rows, _groups(fingers.table))
    candidates.sort(key=attrgetter("score"), reverse=True)
    return _Candidates.of(candidates)


def _switched_forms(
    fingers: FingersOnPlate,
    contents: Contents,
    ringing: Sequence[RingingUnderFingers | None],
) -> tuple[IntArray, Forms]:
    """Return the rows of the table that a single content can use, and the forms there."""
    (stream,) = contents.streams
    (stream_ringing,) = ringing
    quiet = contents.quiet
    if not quiet:
        stream_ringing = None
    rows = contents.rows
    solved_rows = rows
    if stream_ringing is not None:
        rows = stream_ringing.lasting_long_enough(rows)
        solved_rows = np.arange(len(fingers.table.frequencies))
    is_by_point = stream_ringing is None and 1 <= len(quiet) <= MAX_FINGERS_BY_POINT
    finger_forms = fingers.forms(solved_rows, with_fine=is_by_point)
    background = None if contents.background is None else contents.background[solved_rows]
    steady = finger_forms.of(stream.targets, quiet, stream.level_db_sl, background)
    if is_by_point:
        steady = finger_forms.by_point(steady, quiet, CENTER_AND_FOUR)
    return rows, steady if stream_ringing is None else stream_ringing.forms(steady, rows)


def _pattern_candidates(
    forms: Forms, rows: IntArray, groups: Sequence[NDArray[np.bool_]]
) -> list[_Candidate]:
    """Find the best switched patterns of each group of ERAs, for forms at rows."""
    candidates = list[_Candidate]()
    patterns_by_group = _switched_patterns([forms.among(group) for group in groups])
    for group, patterns in zip(groups, patterns_by_group, strict=True):
        for score, pattern in patterns:
            is_within_group = not any(weights[~group].any() for _, weights in pattern)
            if is_within_group:
                drive = [(int(rows[place]), weights) for place, weights in pattern]
                candidates.append(_Candidate(0, 0, score, drive))
    return candidates


_SEARCHES = {"switched": _switched_candidates, "phased": _coherent_candidates}
"""Search for the candidates of a question, by drive mode."""


def _switched_patterns(
    group_forms: Sequence[Forms],
) -> list[list[tuple[float, WeightedTones]]]:
    """Find switched patterns of each group: with the level's margin, without, or the loudest."""
    patterns = [find_switched(forms) for forms in group_forms]
    if any(patterns):
        return patterns
    without_margin = [replace(forms, level_margin=0.0) for forms in group_forms]
    patterns = [find_switched(forms) for forms in without_margin]
    if any(patterns):
        return patterns
    nearly_highest = [
        replace(forms, wanted=NEARLY_HIGHEST * max_sensation_switched(forms))
        for forms in without_margin
    ]
    return [find_switched(forms) for forms in nearly_highest]


def _forms_at(places: IntArray, steady: Forms, ringing: RingingUnderFingers | None) -> Forms:
    """Select forms at some frequencies, by index, over the envelope if the stimulus has one."""
    if ringing is None:
        return steady.at(places)
    return ringing.forms(steady, places)


def _groups(table: LocalizationTable) -> list[NDArray[np.bool_]]:
    """Return masks (n,) of the ERAs that can play one content together, one per group."""
    groups = np.array(table.clocks.groups or [0] * len(table.eras))
    return [groups == group for group in np.unique(groups)]


def _apart(score: Float32Array, frequencies: FloatArray, count: int, apart_hz: float) -> list[int]:
    """Return indices of the two best scores, and of the next best at separate frequencies."""
    chosen = list[int]()
    for index in best_first(score).tolist():
        if score[index] <= 0 or len(chosen) == count:
            break
        distances = np.abs(frequencies[chosen] - frequencies[index])
        is_apart = (distances >= apart_hz - SAME_FREQUENCY).all()
        if len(chosen) < 2 or is_apart:
            chosen.append(index)
    return chosen


def _judged(
    fingers: FingersOnPlate,
    contents: Contents,
    candidates: _Candidates,
    ringing: Sequence[RingingUnderFingers | None],
) -> _Judgment:
    """Evaluate candidates on drawn plates."""
    drives = list[WeightedTones]()
    for number, drive in zip(candidates.contents.tolist(), candidates.drives, strict=True):
        content_ringing = ringing[number]
        drives.append(drive if content_ringing is None else content_ringing.spectrum(drive))
    means, loudest = _felt_in_batches(fingers, drives)
    own = np.empty((len(loudest), loudest.shape[2]))
    least = np.empty(len(loudest))
    for number, stream in enumerate(contents.streams):
        indices = np.flatnonzero(candidates.contents == number)
        content_drives = [candidates.drives[index] for index in indices.tolist()]
        content_ringing = ringing[number]
        others = contents.others(number)
        content_own = means[indices][:, [*stream.targets]].min(axis=1).astype(float)
        content_loudest = loudest[indices]
        if content_ringing is not None and others and not content_ringing.envelope.is_course:
            content_own, content_loudest = _best_in_time(
                fingers,
                content_ringing,
                stream,
                others,
                content_drives,
                content_own,
                content_loudest,
            )
        if content_ringing is None:
            content_least = percentile(content_own[:, 1:])
        else:
            content_least = content_own[:, 0]
        least[indices] = content_least
        if len(contents.streams) > 1:
            gain = contents.levels[number] / np.maximum(content_least, _LEAST_LEVEL)
            content_own = content_own * gain[:, None]
            content_loudest = content_loudest * gain[:, None, None] ** 2
        own[indices] = content_own
        loudest[indices] = content_loudest
    return _Judgment(least, own[:, 1:], loudest[:, :, 1:])


def _best_in_time(
    fingers: FingersOnPlate,
    ringing: RingingUnderFingers,
    stream: Stream,
    others: Sequence[int],
    drives: Sequence[WeightedTones],
    own: FloatArray,
    loudest: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Solve the best drives by energy in time; return amplitude (j, 1 + d) at targets and power
    (j, k, 1 + d) of all drives, with the rest too loud to be chosen.

    own, loudest: the same from the drives' energy.
    """
    contrast = own / np.sqrt(loudest[:, others].max(axis=1))
    order = best_first(percentile(contrast))
    best = order[:IN_TIME]
    best_drives = [drives[index] for index in best.tolist()]
    judged_own = own.copy()
    judged_loudest = np.full_like(loudest, _NEVER_CHOSEN)
    judged_own[best], judged_loudest[best] = _judged_in_time(
        fingers, ringing, stream, best_drives, own[best], loudest[best]
    )
    return judged_own, judged_loudest


def _felt_in_batches(
    fingers: FingersOnPlate, drives: Sequence[WeightedTones]
) -> tuple[Float32Array, FloatArray]:
    """Return mean amplitude over fingertips and power at loudest points, both (m, k, 1 + d)."""
    means = list[Float32Array]()
    loudest = list[Float32Array]()
    for first in range(0, len(drives), _BATCH):
        batch = DriveTones.of(drives[first : first + _BATCH])
        batch_means, batch_loudest = fingers.felt(JUDGING_DRAWS, batch)
        means.append(batch_means)
        loudest.append(batch_loudest)
    return np.concatenate(means), np.concatenate(loudest, dtype=float)


def _judged_in_time(
    fingers: FingersOnPlate,
    ringing: RingingUnderFingers,
    stream: Stream,
    drives: Sequence[WeightedTones],
    own: FloatArray,
    loudest: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return amplitude (j, 1 + d) at targets and power (j, k, 1 + d) of drives solved in time.

    own, loudest: the same from the drives' energy.
    """
    targets = [*stream.targets]
    steady_means, _ = fingers.felt(JUDGING_DRAWS, DriveTones.of(drives))
    steady_own = steady_means[:, targets, 0].min(axis=1)
    sensations = [ringing.over_drive(drive) for drive in drives]
    least_gains = [sensation.gains[targets].min() for sensation in sensations]
    gains = steady_own * least_gains / own[:, 0]
    heard = np.array([sensation.heard.max(axis=1) for sensation in sensations])
    powers = on_drawn_plates(loudest, heard, gains[:, None, None] ** 2)
    return own * gains[:, None], powers


def best_tone(contents: Contents, scores: FloatArray, judgment: _Judgment) -> int:
    """Choose the candidate of a single content: level first, then contrast.

    Without other fingers, the score (m,) counts, and equally a level that varies little among
    plates.
    """
    level = float(contents.levels[0])
    reaches = judgment.least >= level * REACHED
    if not reaches.any():
        reaches[:] = True
    if not contents.quiet:
        steadiness = judgment.least / percentile(judgment.own, 50)
        return best_of(reaches * scores * steadiness)
    foreign_power = judgment.loudest[:, [*contents.quiet]].max(axis=1)
    contrast = judgment.own / np.maximum(np.sqrt(foreign_power), _LEAST_AMPLITUDE)
    return best_of(np.where(reaches, percentile(contrast), 0.0))


def best_combination(
    table: LocalizationTable,
    contents: Contents,
    candidates: _Candidates,
    judgment: _Judgment,
) -> tuple[IntArray, bool]:
    """Choose a candidate for each content (K,); also return whether their frequencies are apart.

    Contents swap bands if they have several. Combinations are extended content by content, and
    only the best `contents.combinations` are kept. Frequencies may be closer than
    `contents.apart_hz` only if no kept combination can be extended otherwise.
    """
    streams = contents.streams
    sensitivities = table.sensitivities[:, candidates.rows]
    for min_distance in (contents.apart_hz, 0.0):
        combinations = np.flatnonzero(candidates.contents == 0)[:, None]
        for number in range(1, len(streams)):
            combinations = _extended(
                table, contents, candidates, combinations, number, min_distance
            )
            if len(combinations) > contents.combinations:
                worst = worst_ratios(
                    combinations,
                    streams,
                    contents.quiet,
                    judgment.own[:, ::PRUNING_STEP],
                    judgment.loudest[:, :, ::PRUNING_STEP],
                    sensitivities,
                )
                combinations = combinations[best_few(worst, contents.combinations)]
        if len(combinations):
            worst = worst_ratios(
                combinations,
                streams,
                contents.quiet,
                judgment.own,
                judgment.loudest,
                sensitivities,
            )
            return combinations[best_of(worst)], min_distance == contents.apart_hz
    raise AssertionError("contents with as many bands must have a combination")


def _extended(
    table: LocalizationTable,
    contents: Contents,
    candidates: _Candidates,
    combinations: IntArray,
    number: int,
    min_distance: float,
) -> IntArray:
    """Extend combinations (c, j) by each candidate of the next content, in all allowed ways.

    min_distance: of their frequencies [Hz].
    """
    frequencies = table.frequencies[candidates.rows]
    next_candidates = np.flatnonzero(candidates.contents == number)
    earlier = np.repeat(combinations, len(next_candidates), axis=0)
    last = np.tile(next_candidates, len(combinations))[:, None]
    distances = np.abs(frequencies[last] - frequencies[earlier])
    is_allowed = (distances >= min_distance - SAME_FREQUENCY).all(axis=1)
    if len(contents.streams[0].bands) > 1:
        is_allowed &= (candidates.bands[last] != candidates.bands[earlier]).all(axis=1)
    return np.concatenate([earlier, last], axis=1)[is_allowed]


def worst_ratios(
    combinations: IntArray,
    streams: Sequence[Stream],
    quiet: Sequence[int],
    own: FloatArray,
    loudest: FloatArray,
    sensitivities: Float32Array,
) -> FloatArray:
    """Return the power ratio at the worst finger on 90 % of plates for combinations (c, j): (c,).

    The lowest over the threshold sets, with sensitivities (s, m). Only the first j contents play;
    own (m, d), loudest (m, k, d): from `_judged`.
    """
    worst_of_sets = np.full(len(combinations), np.inf)
    for factors in sensitivities.astype(float):
        power = loudest * np.square(factors)[:, None, None]
        levels = (own * factors[:, None])[combinations] ** 2
        total = power[combinations].sum(axis=1)
        worst = np.full((len(combinations), own.shape[1]), np.inf)
        if combinations.shape[1] > 1:
            for number, candidate in enumerate(combinations.T):
                for finger in streams[number].targets:
                    foreign_power = np.maximum(
                        total[:, finger] - power[candidate, finger], _LEAST_POWER
                    )
                    worst = np.minimum(worst, levels[:, number] / foreign_power)
        for finger in quiet:
            foreign_power = np.maximum(total[:, finger], _LEAST_POWER)
            worst = np.minimum(worst, levels.min(axis=1) / foreign_power)
        worst_of_sets = np.minimum(worst_of_sets, percentile(worst))
    return worst_of_sets
