"""Recordings of touch panels in evemu's text format."""

import asyncio
from pathlib import Path
from typing import TypeAlias

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.sources.evemu import EvemuSource, read_evemu
from controller.sources.touch import TouchFrame
from model.errors import InputError
from virtual_loop import in_virtual_time

Shown: TypeAlias = list[tuple[float, dict[int, tuple[float, float]]]]

RANGES = """\
# EVEMU 1.3
#     Event code 47 (ABS_MT_SLOT)
#       Value      {slot}
#       Min        0
#       Max        9
#     Event code 53 (ABS_MT_POSITION_X)
#       Value      0
#       Min        0
#       Max      1000
#     Event code 54 (ABS_MT_POSITION_Y)
#       Value      0
#       Min      -100
#       Max       100
#     Event code 57 (ABS_MT_TRACKING_ID)
#       Min        0
#       Max    65535
N: A panel
A: 35 0 1000 0 0 0
################################
#      Waiting for events      #
################################
"""
CODES = {
    "slot": "0003 002f",
    "id": "0003 0039",
    "x": "0003 0035",
    "y": "0003 0036",
    "touch": "0001 014a",
    "tool": "0003 0037",
    "pressure": "0003 003a",
    "major": "0003 0030",
    "distance": "0003 003b",
    "report": "0000 0000",
    "dropped": "0000 0003",
}


def events(*reports: tuple[float, str]) -> str:
    """Reports such as `(0.5, "slot 0 id 7 x 100 y 50")` as evemu writes them."""
    lines = []
    for time, words in reports:
        pairs = words.split()
        for code, value in zip(pairs[::2], pairs[1::2], strict=True):
            lines.append(f"E: {time:.6f} {CODES[code]} {int(value):04d}\t# a comment")
        lines.append(f"E: {time:.6f} {CODES['report']} 0000\t# ------------ SYN_REPORT (0) -----")
    return "\n".join(lines) + "\n"


def write(folder: Path, *reports: tuple[float, str], header: str = RANGES.format(slot=0)) -> Path:
    """A recording in a file."""
    path = folder / "panel.taps.events"
    path.write_text(header + events(*reports), encoding="utf-8")
    return path


def shown(frames: list[TouchFrame]) -> Shown:
    """Frames, to compare."""
    return [
        (round(frame.time, 6), {touch.id: (touch.x, touch.y) for touch in frame.touches})
        for frame in frames
    ]


SEQUENCES: dict[str, tuple[list[tuple[float, str]], Shown]] = {
    "two fingers, unchanged values omitted, times from 0 s": (
        [
            (3.25, "id 7 x 100 y 0"),
            (3.50, "slot 1 id 8 x 900 y 50"),
            (3.75, "x 800 slot 0 y -50"),
            (4.00, "id -1"),
            (4.25, "slot 1 id -1"),
        ],
        [
            (0.0, {7: (0.1, 0.5)}),
            (0.25, {7: (0.1, 0.5), 8: (0.9, 0.75)}),
            (0.5, {7: (0.1, 0.25), 8: (0.8, 0.75)}),
            (0.75, {8: (0.8, 0.75)}),
            (1.0, {}),
        ],
    ),
    "a new contact keeps the coordinates of its slot": (
        [(0, "id 1 x 100 y 0"), (1, "id -1"), (2, "id 2 y 50")],
        [(0.0, {1: (0.1, 0.5)}), (1.0, {}), (2.0, {2: (0.1, 0.75)})],
    ),
    "a position after the lift": (
        [(0, "id 1 x 100 y 0"), (1, "id -1"), (2, "x 200")],
        [(0.0, {1: (0.1, 0.5)}), (1.0, {}), (2.0, {})],
    ),
    "taps within one report": (
        [(0, "id 1 x 100 y 0 id -1"), (1, "id 2 x 300 y 0 id -1 id 3 x 400")],
        [
            (0.0, {1: (0.1, 0.5)}),
            (0.0, {}),
            (1.0, {2: (0.3, 0.5)}),
            (1.0, {}),
            (1.0, {3: (0.4, 0.5)}),
        ],
    ),
    "a lift within one report, the same id again": (
        [(0, "id 1 x 100 y 0"), (1, "id -1 id 1")],
        [(0.0, {1: (0.1, 0.5)}), (1.0, {}), (1.0, {1: (0.1, 0.5)})],
    ),
    "a palm, a finger that becomes one, a hovering finger that lands": (
        [
            (0, "id 1 tool 2 x 100 y 0"),
            (1, "tool 0"),
            (2, "tool 2 slot 1 id 2 distance 5 x 200 y 0"),
            (3, "distance 0"),
        ],
        [(0.0, {}), (1.0, {1: (0.1, 0.5)}), (2.0, {}), (3.0, {2: (0.2, 0.5)})],
    ),
    "another id without -1 before it": (
        [(0, "id 1 x 100 y 0"), (1, "id 2 x 200")],
        [(0.0, {1: (0.1, 0.5)}), (1.0, {2: (0.2, 0.5)})],
    ),
}


@pytest.mark.parametrize("name", SEQUENCES)
def test_read_evemu_follows_slots(tmp_path: Path, name: str) -> None:
    """Frames are those worked out by hand from the multi-touch protocol."""
    reports, expected = SEQUENCES[name]
    assert shown(read_evemu(write(tmp_path, *reports))) == expected


def test_read_evemu_starts_with_the_slot_of_the_header(tmp_path: Path) -> None:
    """Events before the first slot event belong to the slot that the header says is current."""
    reports = ((0, "id 5 x 100 y 0"), (1, "slot 0 id 6 x 200 y 0"), (2, "slot 3 id -1"))
    path = write(tmp_path, *reports, header=RANGES.format(slot=3))
    assert shown(read_evemu(path))[1:] == [
        (1.0, {5: (0.1, 0.5), 6: (0.2, 0.5)}),
        (2.0, {6: (0.2, 0.5)}),
    ]


def test_read_evemu_follows_a_contact_that_was_already_down(tmp_path: Path) -> None:
    """It has a negative id, from when both its coordinates are known."""
    path = write(
        tmp_path, (0, "x 100"), (1, "y 0"), (2, "slot 1 id 4 x 500 y 0"), (3, "slot 0 id -1")
    )
    frames = shown(read_evemu(path))
    assert frames[0] == (0.0, {})
    (early,) = frames[1][1]
    assert early < 0
    assert frames[1][1] == {early: (0.1, 0.5)}
    assert frames[2][1] == {early: (0.1, 0.5), 4: (0.5, 0.5)}
    assert frames[3][1] == {4: (0.5, 0.5)}


def test_read_evemu_lifts_all_after_lost_events(tmp_path: Path) -> None:
    """After SYN_DROPPED a contact is down again once it moves, under a new id."""
    path = write(
        tmp_path,
        (0, "id 1 x 100 y 0"),
        (1, "x 200 dropped 0 id -1 id 9 x 300"),
        (2, "x 400"),
        (3, "y 50"),
        (4, "id -1"),
    )
    frames = shown(read_evemu(path))
    assert frames[1:3] == [(1.0, {}), (2.0, {})]
    (again,) = frames[3][1].items()
    assert again[0] not in (1, 9)
    assert again[1] == (0.4, 0.75)
    assert frames[4] == (4.0, {})


@given(
    st.lists(
        st.lists(
            st.one_of(
                st.tuples(st.just("slot"), st.integers(0, 2)),
                st.tuples(st.just("id"), st.integers(-1, 3)),
                st.tuples(st.sampled_from(["x", "y"]), st.integers(0, 100)),
                st.tuples(st.just("dropped"), st.just(0)),
            ),
            max_size=6,
        ),
        min_size=1,
        max_size=8,
    )
)
def test_read_evemu_invariants_for_any_events(
    tmp_path_factory: pytest.TempPathFactory, reports: list[list[tuple[str, int]]]
) -> None:
    """Times never decrease, and there are at most as many touches as slots."""
    words = [" ".join(f"{code} {value}" for code, value in report) for report in reports]
    path = write(tmp_path_factory.mktemp("any"), *enumerate(words))
    frames = read_evemu(path)
    times = [frame.time for frame in frames]
    assert times == sorted(times)
    slots = {value for report in reports for code, value in report if code == "slot"} | {0}
    assert all(len(frame.touches) <= len(slots) for frame in frames)
    assert len(frames) >= len(reports)


def test_read_evemu_takes_ranges_from_the_desc_file(tmp_path: Path) -> None:
    """A recording without ranges takes them from DEVICE.desc; the slot's value there is stale."""
    header = "# EVEMU 1.0\n"
    path = write(tmp_path, (0, "id 1 x 100 y 30"), (1, "slot 0 x 200"), header=header)
    with pytest.raises(InputError, match=r"ABS_MT_POSITION_X .*\.desc"):
        read_evemu(path)
    (tmp_path / "panel.desc").write_text(
        "N: A panel\n#     Event code 47 (ABS_MT_SLOT)\n#       Value   4\n"
        "A: 2f 0 9 0 0 0\nA: 35 0 400 0 0 0\nA: 36 0 40 0 0 0\n",
        encoding="utf-8",
    )
    assert shown(read_evemu(path)) == [(0.0, {1: (0.25, 0.75)}), (1.0, {1: (0.5, 0.75)})]


MAJOR = "#     Event code 48 (ABS_MT_TOUCH_MAJOR)\n"


@pytest.mark.parametrize(
    ("ranges", "options", "load"),
    [
        ("A: 3a 0 255 0 0 0\n", "", None),
        ("A: 3a 0 255 0 0 1\n", "", (102 / 51) ** (2 / 3)),  # grams, twice the force of a tap
        ("A: 3a 0 255\n", "?light_pressure=102", 1.0),
        ("A: 30 0 255 0 0 10\n", "", (47 / 94) ** 2),  # half the diameter
        (f"{MAJOR}#       Max  255\n#       Resolution  10\n", "", 1 / 4),
    ],
)
def test_evemu_source_reports_loads(
    tmp_path: Path, ranges: str, options: str, load: float | None
) -> None:
    """From the resolutions of its header, or the values of a light press in its URL."""
    header = RANGES.format(slot=0) + ranges
    path = write(tmp_path, (0, "id 1 x 100 y 30 pressure 102 major 47"), header=header)
    (frame, *_) = EvemuSource(f"evemu:{path}{options}").frames
    assert frame.touches[0].load == (None if load is None else pytest.approx(load, rel=2e-3))


GOOD = RANGES.format(slot=0)


@pytest.mark.parametrize(
    ("text", "place"),
    [
        (b"\xff\xfe\x00\x81", "bad.events"),
        (GOOD + "E: 0.0 0003\n", "line 22"),
        (GOOD + "E: nan 0003 0035 0001\n", "line 22"),
        (GOOD + events((2, "x 1"), (1, "x 2")), "line 24"),
        (GOOD + "E: 0.0 0003 002f -001\n", "line 22.*-1"),
        (GOOD + "E: 0.0 0000 0002 0000\n", "line 22.*type B"),
        (GOOD + "hello\n", "line 22.*hello"),
        (GOOD, "bad.events"),
        (GOOD.replace("Max       100", "Max      -100"), "ABS_MT_POSITION_Y.*-100 and -100"),
        ("\x00\x01\x02", "line 1"),
        ("", "ABS_MT_POSITION_X"),
    ],
)
def test_read_evemu_names_file_and_line(tmp_path: Path, text: str | bytes, place: str) -> None:
    """Each error names the file and, where there is one, the line."""
    path = tmp_path / "bad.events"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=place) as caught:
        read_evemu(path)
    assert str(caught.value).startswith(str(path))


@in_virtual_time
async def test_evemu_source_keeps_times(tmp_path: Path) -> None:
    """Frames come at their times; a touched panel at rest repeats itself at most 50 ms apart."""
    path = write(tmp_path, (0, "id 1 x 100 y 0"), (0.12, "x 200"), (0.14, "id -1"), (0.5, "id 2"))
    start = asyncio.get_running_loop().time()
    delivered: list[TouchFrame] = []
    await EvemuSource(f"evemu:{path}").run(delivered.append)
    assert [
        (round(frame.time - start, 6), [touch.id for touch in frame.touches]) for frame in delivered
    ] == [
        (0.0, [1]),
        (0.05, [1]),
        (0.1, [1]),
        (0.12, [1]),
        (0.14, []),
        (0.5, [2]),
        (0.55, []),  # never lifted in the recording
    ]
    assert {frame.source for frame in delivered} == {"evemu:panel.taps.events"}


@pytest.mark.parametrize(
    ("path", "words"),
    [("", "evemu:PATH"), ("missing", "No such file"), ("x?a=b", "evemu:PATH")],
)
def test_evemu_source_refuses_bad_urls(path: str, words: str) -> None:
    """A URL without a readable file is refused before anything is replayed."""
    with pytest.raises(InputError, match=words):
        EvemuSource(f"evemu:{path}")
