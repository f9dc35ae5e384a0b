"""Content files of any format: names, sizes, damage, and the limits of every pattern."""

import math
import os
import random
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from controller.content.formats import Ahap, named_content, named_contents, read_content
from controller.content.pattern import Pattern, Transient
from controller.content.points import pattern_of_points
from model.errors import InputError

Read = Callable[..., Pattern]


def values_of(pattern: Pattern) -> list[float]:
    """Return all intensities and sharpnesses of a pattern."""
    curve_values = [value for _, value in (*pattern.intensity, *pattern.sharpness)]
    return [*curve_values, *(transient.intensity for transient in pattern.transients)]


def test_named_contents_are_short_and_complete() -> None:
    """Each has something to feel within a second, and nothing of it is left out."""
    assert named_contents() == ("click", "error", "selection", "success", "tick", "warning")
    for name in named_contents():
        pattern = read_content(named_content(name))
        assert max(values_of(pattern)) > 0, name
        assert pattern.duration < 1, name
        assert pattern.remarks == (), name


def test_named_content_suggests_a_similar_name() -> None:
    """For a name with a letter missing."""
    with pytest.raises(InputError, match="unknown content 'clik'; did you mean click"):
        named_content("clik")


REFUSED = {
    "old format": ("vij", "", "version 0 of the .haptic format"),
    "binary": ("hmpg", "", "binary form of HJIF; .* `Decoder -f .* `Synthesizer -b"),
    "ending": ("mp3", "", "unknown format of content 'mp3'; known: ahap, haptic, hjif, wav"),
    "large": ("ahap", b" " * (4 << 20) + b"{}", "must be up to 4 MiB long; shorten the content"),
    "large haptic": (
        "haptic",
        b" " * (2 << 20) + b"{}",
        "is larger than 2 MiB; shorten the content",
    ),
    "list": ("ahap", "[]", ":1: must be an object in braces"),
    "comma": (
        "ahap",
        '{\n"Pattern": [1 2]}',
        ":2: is not valid JSON: Expecting ',' delimiter in column 15; correct it there",
    ),
    "trailing zeros": (
        "ahap",
        '{"Pattern": []}\0\0',
        r":1: nothing must follow the end .* got '\\x00\\x00'",
    ),
    "comment": (
        "hjif",
        '{"a": 1}\n# end\n',
        r":2: nothing must follow the end .* got '# end\\n' in column 1; remove it",
    ),
    "cut": (
        "ahap",
        '{"Pattern": [',
        ":1: is not valid JSON: .*; its end is missing: export it again",
    ),
    "trailing comma": ("haptic", '{"a": [1,]}', "is not valid JSON"),
    "encoding": ("ahap", b'{\n"\xff"}', ":2: byte 0xff is not valid UTF-8"),
    "deep": (
        "ahap",
        '{"a":\n' + "[" * 20 + "]" * 20 + "}",
        ":2: is nested more than 20 levels deep",
    ),
    "many values": ("ahap", '{"a": [' + "0," * 99_999 + "0]}", "has more than 100000 values"),
    "repeated key": (
        "ahap",
        '{"Pattern": [{\n"b": 1,\n"b": 2}]}',
        r":3: Pattern\[0\]\.b: is given twice, .* 2",
    ),
    "NaN": ("ahap", '{"Pattern": [],\n"Version": NaN}', ":2: Version: must be a finite number"),
    "infinity": (
        "ahap",
        '{"Pattern": [],\n"Version": 1e999}',
        ":2: Version: must be a finite number",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_content_file_is_refused_before_its_format_reads_it(read: Read, case: str) -> None:
    """With the line, the key if there is one, and what to do."""
    ending, content, message = REFUSED[case]
    with pytest.raises(InputError, match=message):
        read(ending, content)


@pytest.mark.parametrize(
    "create",
    [Path.mkdir, lambda path: None, os.mkfifo],
    ids=["folder", "missing", "pipe"],
)
def test_content_path_without_a_file_is_refused(
    tmp_path: Path, create: Callable[[Path], None]
) -> None:
    """A pipe is refused without waiting for its content."""
    path = tmp_path / "content.ahap"
    create(path)

    with pytest.raises(InputError, match=r"\.ahap: (is a folder|no such file|cannot be read)"):
        read_content(path)


@pytest.mark.parametrize(
    ("name", "channel", "message"),
    [
        ("tick", 1, r"channel must be left out: \.ahap has no channels"),
        ("error", 0, "channel must be at least 1, got 0"),
    ],
)
def test_content_channel_is_refused(name: str, channel: int, message: str) -> None:
    """For a format without channels, and for a channel that does not exist."""
    with pytest.raises(InputError, match=message):
        read_content(named_content(name), channel)


INSERTED = [
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


@pytest.mark.parametrize("name", named_contents())
def test_damaged_content_file_is_read_within_its_limits_or_refused(read: Read, name: str) -> None:
    """Cut, or with parts that are repeated, replaced or nested."""
    rng = random.Random(name)
    path = named_content(name)
    content = path.read_bytes()
    for _ in range(150):
        start, end = sorted(rng.sample(range(len(content)), 2))
        inserted = rng.choice((b"", content[start:end] * 3, rng.choice(INSERTED)))
        rest = content[rng.choice((start, start + 1, end, len(content))) :]
        with suppress(InputError):
            pattern = read(path.suffix[1:], content[:start] + inserted + rest)
            for value in values_of(pattern):
                assert 0 <= value <= 1
            assert 0 <= pattern.duration <= 60


OUT_OF_BOUNDS = {
    "backwards": (Pattern(-1.0), "must last 0 s or longer, got -1 s"),
    "not a number": (Pattern(math.nan), "must last 0 s or longer, got nan s"),
    "long": (Pattern(61.0), "must end within 60 s, got 61 s"),
    "too strong": (
        Pattern(1.0, ((0.0, 3.0),)),
        r"intensity\[0\] must be 0 to 1, got 3 at 0 s",
    ),
    "no sharpness": (
        Pattern(1.0, (), ((0.0, 0.1), (0.5, math.nan))),
        r"sharpness\[1\] must be .* nan at 0.5 s",
    ),
    "order": (
        Pattern(1.0, ((0.5, 1.0), (0.4, 1.0))),
        r"intensity\[1\] must be 0.5 to 60 s, got 0.4 s",
    ),
    "transient": (
        Pattern(1.0, transients=(Transient(0.1, 1.0, 1.5),)),
        r"sharpness of transients\[0\] must be 0 to 1, got 1.5 at 0.1 s",
    ),
}


@pytest.mark.parametrize("case", OUT_OF_BOUNDS)
def test_pattern_of_a_format_is_refused_when_it_is_out_of_bounds(
    read: Read, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    """An intensity of 3 would be felt 20 dB above its level."""
    pattern, message = OUT_OF_BOUNDS[case]
    monkeypatch.setattr(Ahap, "read", lambda *_: pattern)

    with pytest.raises(InputError, match=rf"content\.ahap: .*{message}"):
        read("ahap", "")


def test_pattern_of_points_has_both_curves_and_the_taps() -> None:
    """A point is a time, an intensity and a sharpness; a tap as well."""
    pattern = pattern_of_points([(0, 0.5, 1), (0.2, 1, 0)], [(0.3, 1.0, 0.5)])

    assert pattern.duration == 0.3
    assert pattern.intensity == ((0, 0.5), (0.2, 1))
    assert pattern.sharpness == ((0, 1), (0.2, 0))
    assert pattern.transients == (Transient(0.3, 1.0, 0.5),)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([], "points and taps must be 1 to 500 together, got 0"),
        ([(0, 0, 0)] * 501, "points and taps must be 1 to 500 together, got 501"),
        ([(0, 0)], r"must be \[time_s, intensity, sharpness\], got 2 values in entry 0"),
        ([(1, 0, 0), (0, 0, 0)], r"time of intensity\[1\] must be 1 to 60 s, got 0 s"),
        ([(0, math.nan, 0)], r"intensity\[0\] must be 0 to 1, got nan"),
    ],
    ids=["none", "many", "short", "order", "not a number"],
)
def test_pattern_of_points_refuses_a_point_and_names_it(
    points: list[tuple[float, ...]], message: str
) -> None:
    """The number of points, their form, order and range."""
    with pytest.raises(InputError, match=message):
        pattern_of_points(points)
