"""Faults on demand: read from a file, and what they do to telegrams on their way."""

import asyncio
from pathlib import Path

import pytest

from model.errors import InputError
from sim.faults.fault_file import load_faults
from sim.faults.fault_window import FaultKind, Faults, FaultWindow
from sim.transport.line import Line

TELEGRAM = bytes(range(40))


def write(tmp_path: Path, text: str) -> Path:
    """A fault file."""
    path = tmp_path / "faults.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_file_says_what_goes_wrong_and_when(tmp_path: Path) -> None:
    """Times with units or in seconds; what names an amplifier is of that one only."""
    path = write(
        tmp_path,
        "seed: 7\n"
        "faults:\n"
        "  - {fault: drop, at: 2, lasts: 1500 ms, share: 20 %, toward: host}\n"
        "  - {fault: unplug, at: 5, amplifier: west}\n",
    )
    file = load_faults(path, amplifiers=["east", "west"])
    east = file.of("east", begin=100.0)
    assert east.windows == [FaultWindow("drop", 2.0, 1.5, share=0.2, toward="host")]
    assert len(file.of("west", begin=100.0).windows) == 2
    assert [east.now("drop", time) for time in (101.9, 102.0, 103.4, 103.5)] == [
        *(False, True, True, False)
    ]


def test_every_mistake_is_told_with_its_line(tmp_path: Path) -> None:
    """Unknown faults, amplifiers and keys, and values out of range, all at once."""
    path = write(
        tmp_path,
        "faults:\n"
        "  - {fault: dropp}\n"
        "  - {fault: arc, amplifier: mian}\n"
        "  - {fault: arc, att: 3}\n"
        "  - {fault: drop, share: 1.5}\n",
    )
    with pytest.raises(InputError) as caught:
        load_faults(path, amplifiers=["main"])
    told = str(caught.value)
    for line, word in ((2, "dropp"), (3, "mian"), (4, "att"), (5, "share")):
        assert any(f":{line}:" in row and word in row for row in told.splitlines()), told


@pytest.mark.parametrize(
    ("kind", "is_so"),
    [
        ("drop", lambda arrived: arrived == []),
        ("duplicate", lambda arrived: arrived == [(0.0, TELEGRAM)] * 2),
        (
            "truncate",
            lambda arrived: TELEGRAM.startswith(arrived[0][1]) and len(arrived[0][1]) < 40,
        ),
        ("incomplete_set", lambda arrived: len(arrived[0][1]) < 40),
        ("delay", lambda arrived: 0 < arrived[0][0] <= 0.1 and arrived[0][1] == TELEGRAM),
        ("corrupt", lambda arrived: 1 <= flipped_bits(arrived[0][1]) <= 3),
    ],
)
def test_what_befalls_a_telegram(kind: str, is_so: "object") -> None:
    """Each fault does what its name says, and only while it is on."""
    faults = Faults([FaultWindow(kind, at=1.0, lasts=1.0)], begin=10.0, seed=3)
    assert is_so(faults.pass_on(TELEGRAM, toward="amplifier", time=11.5))
    for time in (10.5, 12.0):
        assert faults.pass_on(TELEGRAM, toward="amplifier", time=time) == [(0.0, TELEGRAM)]


def flipped_bits(data: bytes) -> int:
    """How many bits differ from the telegram."""
    return sum((a ^ b).bit_count() for a, b in zip(data, TELEGRAM, strict=True))


def test_a_share_of_telegrams_in_one_direction() -> None:
    """A fifth of many, those towards the host only; the same seed, the same ones."""
    runs = []
    for _ in range(2):
        faults = Faults([FaultWindow("drop", share=0.2, toward="host")], seed=5)
        runs.append([bool(faults.pass_on(TELEGRAM, toward="host", time=1.0)) for _ in range(2000)])
    assert runs[0] == runs[1]
    assert 0.17 < runs[0].count(False) / 2000 < 0.23
    assert faults.pass_on(TELEGRAM, toward="amplifier", time=1.0)


async def test_bytes_take_their_time_one_after_the_other() -> None:
    """At 100 kbit/s forty bytes of ten bits take 4 ms, and the next forty 4 ms more."""
    loop = asyncio.get_running_loop()
    arrived: list[float] = []
    line = Line(
        lambda data: arrived.append(loop.time()),
        toward="host",
        faults=Faults(),
        bits_per_second=100_000,
    )
    begin = loop.time()
    line.send(TELEGRAM)
    line.send(TELEGRAM)
    assert arrived == []
    async with asyncio.timeout(5):
        while True:
            if len(arrived) == 2:
                break
            await asyncio.sleep(0.001)
    assert arrived[0] - begin >= 0.004 - 1e-4
    assert arrived[1] - begin >= 0.008 - 1e-4


async def test_a_closed_line_delivers_nothing_more() -> None:
    """What is on the way when the wire is pulled out is lost."""
    arrived: list[bytes] = []
    line = Line(arrived.append, toward="host", faults=Faults(), bits_per_second=1000)
    line.send(b"x")
    line.close()
    await asyncio.sleep(0.02)
    assert arrived == []


def test_a_telegram_may_be_cut_and_flipped_by_several_faults_at_once() -> None:
    """What is cut to nothing does not arrive, and nothing stumbles over it."""
    kinds: tuple[FaultKind, ...] = ("truncate", "truncate", "corrupt", "incomplete_set")
    faults = Faults([FaultWindow(kind) for kind in kinds])
    arrived = [faults.pass_on(b"ab", toward="amplifier", time=1.0) for _ in range(200)]
    assert {len(data) for telegrams in arrived for _, data in telegrams} <= {1}
    assert [] in arrived
