"""Files of content: which are refused before their format reads them, and what none may do."""

import math
import os
import random
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from controller.content.formats import (
    Ahap,
    content_formats,
    named_content,
    named_contents,
    read_content,
)
from controller.content.pattern import Pattern, Transient, pattern_of_points, points_of
from model.errors import InputError

Read = Callable[..., Pattern]

PARTS = [
    b"[" * 30,
    b'{"a":' * 30,
    b'"',
    b"\\",
    b"NaN",
    b"1e999",
    b"9" * 5000,
    b"\xff",
    b"null",
    b",",
]


def test_named_contents_are_felt(tmp_path: Path) -> None:
    """Every one has something to feel within a second, and nothing of it is left out."""
    assert named_contents() == ("click", "error", "selection", "success", "tick", "warning")
    for name in named_contents():
        pattern = read_content(named_content(name))
        assert max([*(v for _, v in pattern.intensity), *(t.intensity for t in pattern.transients)])
        assert pattern.duration < 1
        assert pattern.remarks == ()
    with pytest.raises(InputError, match="unknown content 'clik'; did you mean click"):
        named_content("clik")


@pytest.mark.parametrize(
    ("ending", "given", "words"),
    [
        ("vij", "", "version 0 of the .haptic format"),
        ("hmpg", "", "binary form of HJIF; .* `Decoder -f .* `Synthesizer -b"),
        ("mp3", "", "unknown format of content 'mp3'; known are ahap, haptic, hjif, wav"),
        ("ahap", b" " * (4 << 20) + b"{}", "must be up to 4 MiB long; shorten the content"),
        ("ahap", "[]", ":1: must be an object in braces"),
        (
            "ahap",
            '{\n"Pattern": [1 2]}',
            ":2: is not valid JSON: Expecting ',' delimiter in column 15; correct it there",
        ),
        ("ahap", '{"Pattern": [', ":1: is not valid JSON: .*; its end is missing: export it again"),
        ("haptic", b" " * (2 << 20) + b"{}", "is larger than 2 MiB; shorten the content"),
        ("haptic", '{"a": [1,]}', "is not valid JSON"),
        ("ahap", b'{\n"\xff"}', ":2: byte 0xff is no UTF-8"),
        ("ahap", '{"a":\n' + "[" * 20 + "]" * 20 + "}", ":2: is nested more than 20 levels deep"),
        ("ahap", '{"a": [' + "0," * 99_999 + "0]}", "has more than 100000 values"),
        (
            "ahap",
            '{"Pattern": [{\n"b": 1,\n"b": 2}]}',
            r":3: Pattern\[0\]\.b: is given twice, .* 2",
        ),
        ("ahap", '{"Pattern": [],\n"Version": NaN}', ":2: Version: must be a finite number"),
        ("ahap", '{"Pattern": [],\n"Version": 1e999}', ":2: Version: must be a finite number"),
    ],
)
def test_refusal_before_a_format_reads(
    read: Read, ending: str, given: str | bytes, words: str
) -> None:
    """Other endings, what is too much, no JSON, or given twice: with the line and the key."""
    with pytest.raises(InputError, match=words):
        read(ending, given)


def test_files_that_are_none(tmp_path: Path) -> None:
    """A folder, a missing file and a pipe are refused without waiting; so is a channel of AHAP."""
    for name, make in (("folder", Path.mkdir), ("missing", None), ("pipe", os.mkfifo)):
        path = tmp_path / f"{name}.ahap"
        if make:
            make(path)
        with pytest.raises(InputError, match=r"\.ahap: (is a folder|no such file|cannot be read)"):
            read_content(path)
    with pytest.raises(InputError, match=r"channel must be left out: \.ahap has no channels"):
        read_content(named_content("tick"), 1)
    with pytest.raises(InputError, match="channel must be at least 1, got 0"):
        read_content(named_content("error"), 0)


@pytest.mark.parametrize("name", named_contents())
def test_damaged_file_is_read_or_refused(read: Read, name: str) -> None:
    """Cut, with parts repeated, replaced or nested: InputError, or values within their bounds."""
    rng = random.Random(name)
    path = named_content(name)
    whole = path.read_bytes()
    for _ in range(150):
        at, end = sorted(rng.sample(range(len(whole)), 2))
        middle = rng.choice((b"", whole[at:end] * 3, rng.choice(PARTS)))
        damaged = whole[:at] + middle + whole[rng.choice((at, at + 1, end, len(whole))) :]
        with suppress(InputError):
            pattern = read(path.suffix[1:], damaged)
            values = [
                value for curve in (pattern.intensity, pattern.sharpness) for _, value in curve
            ]
            values += [each.intensity for each in pattern.transients]
            assert all(0 <= value <= 1 for value in values)
            assert 0 <= pattern.duration <= 60


@pytest.mark.parametrize(
    ("pattern", "words"),
    [
        (Pattern(-1.0), "must last 0 s or longer, got -1 s"),
        (Pattern(math.nan), "must last 0 s or longer, got nan s"),
        (Pattern(61.0), "must end within 60 s, got 61 s"),
        (Pattern(1.0, ((0.0, 3.0),)), r"intensity\[0\] must be 0 to 1, got 3 at 0 s"),
        (
            Pattern(1.0, (), ((0.0, 0.1), (0.5, math.nan))),
            r"sharpness\[1\] must be .* nan at 0.5 s",
        ),
        (Pattern(1.0, ((0.5, 1.0), (0.4, 1.0))), r"intensity\[1\] must be 0.5 to 60 s, got 0.4 s"),
        (
            Pattern(1.0, transients=(Transient(0.1, 1.0, 1.5),)),
            r"sharpness of transients\[0\] must be 0 to 1, got 1.5 at 0.1 s",
        ),
    ],
    ids=["backwards", "no number", "long", "too strong", "no sharpness", "order", "transient"],
)
def test_what_a_format_makes_is_within_bounds(
    read: Read, monkeypatch: pytest.MonkeyPatch, pattern: Pattern, words: str
) -> None:
    """Or the file is refused: an intensity of 3 would be felt 20 dB above its level."""
    monkeypatch.setattr(Ahap, "read", lambda *_: pattern)
    with pytest.raises(InputError, match=rf"content\.ahap: .*{words}"):
        read("ahap", "")


def test_points_and_taps_of_a_program() -> None:
    """Both curves of the points, and taps; one out of place is named."""
    tap = (0.3, 1.0, 0.5)
    pattern = pattern_of_points([(0, 0.5, 1), (0.2, 1, 0)], [tap])
    taps = (Transient(*tap),)
    assert pattern == Pattern(0.3, ((0, 0.5), (0.2, 1)), ((0, 1), (0.2, 0)), taps)
    for points, words in (
        ([], "points and taps must be 1 to 500 together, got 0"),
        ([(0, 0, 0)] * 501, "points and taps must be 1 to 500 together, got 501"),
        ([(0, 0)], r"points\[0\] must be \[time_s, intensity, sharpness\], got 2 values"),
        ([(1, 0, 0), (0, 0, 0)], r"points\[1\] time_s must be 1 to 60, got 0"),
        ([(0, float("nan"), 0)], r"points\[0\] intensity must be 0 to 1, got nan"),
    ):
        with pytest.raises(InputError, match=words):
            pattern_of_points(points)


def test_points_are_given_of_a_pattern_whose_curves_have_their_own_times() -> None:
    """A step stays one; sharpness is given at its own times too; 2 001 points become 500."""
    level, sharp = ((0.0, 0.0), (0.1, 1.0), (0.1, 0.5), (0.4, 0.5)), ((0.0, 0.0), (0.2, 1.0))
    points, taps = points_of(Pattern(0.4, level, sharp, (Transient(0.3, 1, 0),)))
    assert points == [(0, 0, 0), (0.1, 1, 0.5), (0.1, 0.5, 0.5), (0.2, 0.5, 1), (0.4, 0.5, 1)]
    assert taps == [(0.3, 1, 0)]
    rise = tuple((number / 1000, number / 2000) for number in range(2001))
    many, _ = points_of(Pattern(2.0, rise[::5], rise, (Transient(0.3, 1, 0),)))
    assert len(many) == 499
    assert max(abs(each - time / 2) for time, *both in many for each in both) < 1e-9


def test_formats_are_listed() -> None:
    """Those of the project first."""
    assert content_formats()[:4] == ("ahap", "haptic", "hjif", "wav")
