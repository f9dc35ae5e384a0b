"""Read content: the base class of all formats, strict JSON, mixing of vibrations, and WAV files.

The size of JSON files is checked before they are parsed; line numbers are determined only for
errors. Simultaneous continuous vibrations are mixed into one intensity and one sharpness curve.

A WAV signal is felt by the strength of its vibration, not by its waveform. It is split into two
bands, below and above 140 Hz. Intensity is the total amplitude of both bands, 1 for a full-scale
sine; sharpness is that of the stronger band. Components outside the frequency range of sharpness
are left out, with a remark in dB.
"""

import json
import math
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator
from functools import partial
from typing import Annotated, Any, ClassVar, NamedTuple, TypeAlias, TypeVar

import numpy as np
from pydantic import ConfigDict, GetCoreSchemaHandler

from controller.content.pattern import (
    MAX_CONTENT_DURATION,
    MAX_HZ,
    MIN_HZ,
    Curve,
    Pattern,
    sharpness_of,
)
from model.arrays import FloatArray
from model.config.document import ConfigError, ConfigProblem, Document, KeyPath, decoded, key_name
from model.config.fields import Section
from model.errors import InputError, shown
from model.files.wav_file import samples_of
from model.quantities import counted, percent
from registry.plugins import did_you_mean

MAX_SIZE = 4 << 20
"""Largest file [bytes]."""

_MAX_POINTS = 20_000
"""Maximum number of points in a file: breakpoints, keyframes, or events and their parts."""


def refusal(source: str, message: str, *, line: int | None = None, key: str = "") -> ConfigError:
    """Return an error for a whole file, or for a key on a line."""
    return ConfigError(source, [ConfigProblem(line, key, message)])


def too_much(end: float, count: int) -> str:
    """Return the problem of content with too late an end [s] or too many points, or ""."""
    if end > MAX_CONTENT_DURATION:
        return f"must end within {MAX_CONTENT_DURATION:g} s, got {end:g} s; shorten it"
    return f"has more than {_MAX_POINTS} points; leave some out" if count > _MAX_POINTS else ""


class ContentFormat(ABC):
    """A content format, named after the extension of its files."""

    ending: ClassVar[str]
    """File extension without the dot, in lower case."""

    has_channels: ClassVar[bool] = False
    """Whether a file can have several channels; one of them is read."""

    @abstractmethod
    def read(self, content: bytes, source: str, channel: int) -> Pattern:
        """Return the pattern of a file.

        content: all bytes of the file; source: its name, for errors; channel: counted from 1.
        Raises InputError for an invalid file, with line and key if available. Must not execute or
        read anything that the file refers to.
        """


_MAX_SIZE = 2 << 20  # bytes
_MAX_LEVELS = 20
_MAX_VALUES = 5 * _MAX_POINTS  # an HJIF keyframe has four, an AHAP event thirteen
_MAX_QUOTED = 50  # characters in errors
_MAX_NAMED = 5  # unknown names in a remark
_MAX_NAME = 40  # characters of a name to compare with known names
_EMPTY: tuple[object, ...] = (None, "", [], {})

_STRING = r'"[^"\\]*+(?:\\.?+[^"\\]*+)*+"?'  # or an unterminated one: no text is read twice
_STRINGS = re.compile(_STRING, re.DOTALL)
_TRAILING_COMMA = re.compile(rf"({_STRING})|,(?=[ \t\n\r]*[\]}}])", re.DOTALL)
_TOKENS = re.compile(rf"{_STRING}|[{{}}\[\],:]|[^\s{{}}\[\],:\"]+", re.DOTALL)

_T = TypeVar("_T")


class _FirstOfMany:
    """Annotation of a list: report only the first invalid entry.

    pydantic's FailFast does not work in a union.
    """

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> Any:
        return {**handler(source), "fail_fast": True, "max_length": _MAX_POINTS}


Entries: TypeAlias = Annotated[list[_T], _FirstOfMany()]
"""A list that reports only its first invalid entry."""


class ContentSection(Section):
    """An object in a content file: strict types, finite numbers; unknown keys are ignored."""

    model_config = ConfigDict(extra="allow", strict=True, frozen=True, allow_inf_nan=False)


def read_json(content: bytes, source: str, *, has_trailing_commas: bool = False) -> Document:
    """Read an object; raises ConfigError if it is invalid, nested too deep, or repeats a key."""
    if len(content) > _MAX_SIZE:
        raise refusal(source, f"is larger than {_MAX_SIZE >> 20} MiB; shorten the content")
    text = decoded(source, content).removeprefix("\ufeff")
    if has_trailing_commas:
        text = _TRAILING_COMMA.sub(lambda found: found[1] or " ", text)
    _check_size(source, text)
    find_lines = partial(_lines_of, source, text)
    with_repeats = list[dict[str, Any]]()

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        given = dict(pairs)
        if len(given) < len(pairs):
            with_repeats.append(given)
        return given

    try:
        # Integers become floats, so that huge ones are rejected by their size, like 1e999.
        data = json.loads(text, parse_int=float, object_pairs_hook=unique)
    except json.JSONDecodeError as error:
        raise refusal(source, _why_unparsed(text, error), line=error.lineno) from error
    if not isinstance(data, dict):
        raise refusal(source, "must be an object in braces, got another value", line=1)
    if with_repeats:
        find_lines()  # raises
    return Document(source, text, data, find_lines)


def _why_unparsed(text: str, error: json.JSONDecodeError) -> str:
    if error.msg == "Extra data":
        surplus = shown(text[error.pos : error.pos + _MAX_QUOTED])
        return (
            f"nothing must follow the end of the content, got {surplus} in column "
            f"{error.colno}; remove it"
        )
    is_cut = not text.rstrip().endswith("}")
    remedy = "its end is missing: export it again" if is_cut else "correct it there"
    return f"is not valid JSON: {error.msg} in column {error.colno}; {remedy}"


def unknown_keys(section: ContentSection, but: Collection[str] = ()) -> tuple[str, ...]:
    """Return a remark listing the first unknown keys of a file, if any.

    but: keys that do not affect the vibration; empty keys are ignored too.
    """
    names = Counter(name for name in _extra(section) if name not in but)
    return names_remark("unknown key", names, verb="ignored")


def names_remark(
    thing: str, names: Counter[str], *, verb: str = "left out", known: Collection[str] = ()
) -> tuple[str, ...]:
    """Return a remark listing the first names in a file without an effect, if any.

    known: valid names, for suggestions.
    """
    if not names:
        return ()
    listed = [_suggested(name, known) for name in list(names)[:_MAX_NAMED]]
    if len(names) > _MAX_NAMED:
        listed.append(f"and {len(names) - _MAX_NAMED} others")
    return (f"{counted(names.total(), thing)} {verb}: {', '.join(listed)}",)


def _suggested(name: str, known: Collection[str]) -> str:
    """Format a name from a file, suggesting a similar known name."""
    named = key_name((name,))
    suggestion = did_you_mean(name[:_MAX_NAME], known).strip()
    return f"{named} ({suggestion})" if suggestion else named


def _extra(value: Any) -> Iterator[str]:
    if isinstance(value, list):
        for entry in value:
            yield from _extra(entry)
    elif isinstance(value, ContentSection):
        yield from (k for k, each in (value.model_extra or {}).items() if each not in _EMPTY)
        for name in type(value).model_fields:
            yield from _extra(getattr(value, name))


def _lines_of(source: str, text: str) -> dict[KeyPath, int]:
    """Return the line of every key and list entry of JSON; raises ConfigError for a repeat."""
    lines: dict[KeyPath, int] = {}
    path: list[str | int] = []  # of the next value
    line, at, is_key = 1, 0, False
    for found in _TOKENS.finditer(text):
        line, at, sign = line + text.count("\n", at, found.start()), found.start(), found[0]
        if sign in ("}", "]"):
            path.pop()
            is_key = False
        elif sign == ",":
            last = path[-1]
            is_key = isinstance(last, str)
            path[-1] = last if isinstance(last, str) else last + 1
        elif sign != ":":
            if is_key:
                path[-1] = json.loads(sign)
            where = tuple(path)
            if is_key and where in lines:
                message = f"is given twice, first on line {lines[where]}; remove one"
                raise refusal(source, message, line=line, key=key_name(where))
            lines.setdefault(where, line)
            is_key = sign == "{"
            if sign in ("{", "["):
                path.append("" if is_key else 0)
    return lines


def _check_size(source: str, text: str) -> None:
    """Reject text with too deep nesting or too many values before parsing it."""
    bare = _STRINGS.sub("", text)
    codes = np.frombuffer(bare.encode("utf-32-le", "surrogatepass"), np.uint32)
    opened = (codes == ord("{")) | (codes == ord("["))
    levels = np.cumsum(opened.astype(int) - ((codes == ord("}")) | (codes == ord("]"))))
    if len(levels) and levels.max() > _MAX_LEVELS:
        line = _line(bare, int(np.argmax(levels > _MAX_LEVELS)))
        raise refusal(source, f"is nested more than {_MAX_LEVELS} levels deep", line=line)
    if np.count_nonzero(opened | (codes == ord(","))) > _MAX_VALUES:
        raise refusal(source, f"has more than {_MAX_VALUES} values; shorten it")


def _line(text: str, at: int) -> int:
    return text.count("\n", 0, at) + 1


Segment: TypeAlias = tuple[float, float, float, float, float, float]
"""Start and end [s], intensity at both, sharpness at both; straight lines between."""

_STEP = 0.005  # s; within it, products and sums of straight lines count as straight
_DIGITS = 9  # times are rounded to nanoseconds, so that none are almost equal
_MAX_OVERLAP = 1_000_000  # segment parts


def mixed(
    source: str,
    segments: list[Segment],
    *,
    factor: Curve = ((0.0, 1.0),),
    addend: Curve = ((0.0, 0.0),),
) -> tuple[Curve, Curve]:
    """Return intensity and sharpness of segments that may overlap.

    Intensities add as powers, up to 1; the strongest segment determines the sharpness. factor,
    addend: applied to all intensities and sharpnesses over time. source: file name, for errors.
    """
    rows = np.array(segments).reshape(-1, 6)
    rows[:, :2] = rows[:, :2].round(_DIGITS)
    rows = rows[rows[:, 1] > rows[:, 0]]
    if not len(rows):
        return (), ()
    begins, ends = rows[:, 0], rows[:, 1]
    given = [time for curve in (factor, addend) for time, _ in curve]
    grid = np.arange(begins.min(), ends.max(), _STEP)
    knots = np.unique(np.concatenate([begins, ends, np.round([*grid, *given], _DIGITS)]))
    knots = knots[(knots >= begins.min()) & (knots <= ends.max())]
    first = np.searchsorted(knots, begins)
    counts = np.searchsorted(knots, ends) - first
    if counts.sum() > _MAX_OVERLAP:
        raise refusal(source, "has too many events that overlap; shorten them")
    which = np.repeat(np.arange(len(rows)), counts)
    at = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts - first, counts)
    limits = np.stack([knots[at], knots[at + 1]])
    share = (limits - begins[which]) / (ends - begins)[which]
    levels, sharps = (
        rows[which, column] + share * (rows[which, column + 1] - rows[which, column])
        for column in (2, 4)
    )
    count = len(knots) - 1
    power = np.stack([np.bincount(at, level**2, minlength=count) for level in levels])
    order = np.argsort(levels.sum(axis=0), kind="stable")
    sharpness = np.full((2, count), np.nan)
    sharpness[:, at[order]] = sharps[
        :, order
    ]  # for equal indices the last one, the strongest, is kept
    intensity = np.sqrt(power) * stretches_between(factor, knots)
    sharpness += stretches_between(addend, knots)
    return _curve(knots, np.clip(intensity, 0, 1)), _curve(knots, np.clip(sharpness, 0, 1))


def stretches_between(curve: Curve, knots: FloatArray) -> FloatArray:
    """Return a curve (2, n) just inside both ends of each interval between knots."""
    times, values = np.array(curve).T
    times = times.round(_DIGITS)
    width = np.diff(knots)
    early, late = (np.interp(knots[:-1] + part * width, times, values) for part in (0.25, 0.75))
    return np.stack([1.5 * early - 0.5 * late, 1.5 * late - 0.5 * early])


def _curve(knots: FloatArray, values: FloatArray) -> Curve:
    """Return the points of a curve; values (2, n) at both ends of each interval."""
    times = np.stack([knots[:-1], knots[1:]], axis=1).ravel()
    course = values.T.ravel()
    is_given = ~np.isnan(course)
    return _thinned(times[is_given], course[is_given])


def _thinned(times: FloatArray, values: FloatArray) -> Curve:
    """Remove points that repeat another or are on the line between their neighbours."""
    is_new = np.ones(len(times), bool)
    is_new[1:] = (np.diff(times) > 0) | (abs(np.diff(values)) > 1e-12)
    times, values = times[is_new], values[is_new]
    is_kept = np.ones(len(times), bool)
    if len(times) > 2:
        width = times[2:] - times[:-2]
        along = np.divide(
            times[1:-1] - times[:-2], width, out=np.zeros_like(width), where=width > 0
        )
        straight = values[:-2] + along * (values[2:] - values[:-2])
        is_step = (np.diff(times)[:-1] == 0) | (np.diff(times)[1:] == 0)
        is_kept[1:-1] = is_step | (abs(values[1:-1] - straight) > 1e-12)
    return tuple(zip(times[is_kept].tolist(), values[is_kept].tolist(), strict=True))


_RATE = 200  # points a second, or a little more
_PER_POINT = 10  # samples of the analytic signal
_SPLIT = (110.0, 178.0)  # Hz; half an octave on both sides of the split fades over
_OUTER_LOW, _OUTER_HIGH = (45.0, MIN_HZ), (MAX_HZ, 430.0)  # Hz; faded out beyond
_FLOOR = 0.03  # of the highest intensity; ringing of the band filters around a burst is below
_MIN_RATE, _MAX_RATE = 1000, 192_000
_MIN_LOST = 0.01  # of the energy


class Wav(ContentFormat):
    """Sampled signals, as PCM or float."""

    ending = "wav"
    has_channels = True

    def read(self, content: bytes, source: str, channel: int) -> Pattern:
        """Return the pattern of one channel."""
        try:
            rate, samples = samples_of(content)
        except InputError as error:
            raise refusal(source, str(error)) from error
        if not _MIN_RATE <= rate <= _MAX_RATE:
            raise refusal(source, f"sample rate must be {_MIN_RATE} to {_MAX_RATE} Hz, got {rate}")
        if problem := too_much(len(samples) / rate, 0):
            raise refusal(source, problem)
        count = samples.shape[1]
        if count > 2:
            raise refusal(source, f"must have 1 or 2 channels, got {count}")
        if channel > count:
            raise refusal(source, f"channel must be 1 to {count}, got {channel}")
        signal = samples[:, channel - 1]
        course = course_of(signal, rate)
        remarks = course.remarks
        if count == 2:
            remarks = (f"channel {channel} of 2 read", *remarks)
        return Pattern(
            len(signal) / rate,
            course.intensity,
            course.sharpness,
            remarks=remarks,
            out_of_band_share=course.out_of_band_share,
        )


class SignalCourse(NamedTuple):
    """A sampled signal as intensity and sharpness over time."""

    intensity: Curve
    sharpness: Curve
    out_of_band_share: float
    """Share of the signal's energy outside the frequencies of sharpness, 0 to 1."""
    remarks: tuple[str, ...]


def course_of(signal: FloatArray, rate: int) -> SignalCourse:
    """Return intensity and sharpness of a signal at a rate [Hz]."""
    import scipy.fft

    duration = len(signal) / rate
    # At least a second longer, so that the end does not wrap around to the start.
    length = scipy.fft.next_fast_len(len(signal) + rate, real=True)
    cycle = length / rate  # s
    spectrum = scipy.fft.rfft(signal, length)[1:] / length
    frequencies = np.arange(1, math.ceil(_OUTER_HIGH[1] * cycle)) / cycle
    outer = _rise(frequencies, *_OUTER_LOW) * _rise(1 / frequencies, *_inverse(_OUTER_HIGH))
    upper = _rise(frequencies, *_SPLIT)
    lower = _rise(1 / frequencies, *_inverse(_SPLIT))
    points = scipy.fft.next_fast_len(math.ceil(cycle * _RATE))
    step = cycle / points
    count = math.ceil(duration / step)
    levels, centres = zip(
        *(
            _band(spectrum[: len(outer)] * outer * band, points, step, count)
            for band in (lower, upper)
        ),
        strict=True,
    )
    intensity = np.hypot(*levels)
    intensity[intensity < _FLOOR * intensity.max()] = 0
    sharpness = sharpness_of(np.where(levels[1] > levels[0], *centres[::-1]))
    times = (np.arange(count) + 0.5) * step
    times[-1] = min(times[-1], duration)
    is_felt = intensity > 0
    given = np.concatenate([[0], times, [duration]])
    course = np.concatenate([intensity[:1], np.minimum(intensity, 1), intensity[-1:]]).clip(0, 1)
    out_of_band_share = _out_of_band_share(spectrum, outer)
    return SignalCourse(
        _thinned(given, course),
        _thinned(times[is_felt], sharpness[is_felt]),
        out_of_band_share,
        tuple(_signal_remarks(out_of_band_share, intensity)),
    )


def _out_of_band_share(spectrum: Any, outer: FloatArray) -> float:
    """Return the share of a spectrum's energy that a filter of its lowest lines removes."""
    power = abs(spectrum) ** 2
    total = float(power.sum())
    if not total:
        return 0.0
    kept = float((power[: len(outer)] * outer**2).sum())
    return 1 - kept / total


def _signal_remarks(out_of_band_share: float, intensity: FloatArray) -> Iterator[str]:
    """Yield a remark for each loss in the conversion of a signal."""
    if out_of_band_share > _MIN_LOST:
        level_db = 10 * math.log10(out_of_band_share)
        yield (
            f"{percent(out_of_band_share)} of its energy ({level_db:.1f} dB) "
            f"is outside {MIN_HZ:g} to {MAX_HZ:g} Hz and left out"
        )
    is_clamped = intensity > 1
    if is_clamped.any():
        yield f"{percent(is_clamped.mean())} of the time above full scale, clamped"


def _band(spectrum: Any, points: int, step: float, count: int) -> tuple[FloatArray, FloatArray]:
    """Return amplitude and centre frequency [Hz] of a band at the first points.

    points: number in the whole cycle, a step [s] apart.
    """
    bins = np.zeros(points * _PER_POINT, complex)
    bins[1 : len(spectrum) + 1] = 2 * spectrum
    analytic = np.fft.ifft(bins, norm="forward")
    power = (abs(analytic) ** 2).reshape(-1, _PER_POINT).mean(axis=1)
    turned = (np.roll(analytic, -1) * analytic.conj()).reshape(-1, _PER_POINT).sum(axis=1)
    return np.sqrt(power[:count]), np.angle(turned[:count]) * _PER_POINT / (2 * math.pi * step)


def _rise(frequencies: FloatArray, low: float, high: float) -> FloatArray:
    """Return a fade from 0 to 1 between two frequencies; with its mirror, powers add to 1."""
    share = np.log(frequencies / low) / math.log(high / low)
    return np.asarray(np.sin(share.clip(0, 1) * math.pi / 2))


def _inverse(edges: tuple[float, float]) -> tuple[float, float]:
    return 1 / edges[1], 1 / edges[0]
