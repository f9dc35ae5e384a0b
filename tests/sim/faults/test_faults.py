"""Fault files, and faults of frames."""

import asyncio
from pathlib import Path

import pytest

from model.errors import InputError
from sim.faults import FaultKind, Faults, FaultWindow, load_faults
from sim.process.simulation import STEP, SteppedLoop
from sim.transport.simulated_line import Line

FRAME = bytes(range(40))


def write(tmp_path: Path, text: str) -> Path:
    """A fault file."""
    path = tmp_path / "faults.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_load_faults_reads_times_units_and_amplifiers(tmp_path: Path) -> None:
    """Times are in seconds or with a unit; a named amplifier gets its own faults only."""
    path = write(
        tmp_path,
        "seed: 7\n"
        "faults:\n"
        "  - {fault: drop, at: 2, lasts: 1500 ms, share: 20 %, toward: host}\n"
        "  - {fault: unplug, at: 5, amplifier: west}\n",
    )
    file = load_faults(path, amplifiers=["east", "west"])
    east = file.of("east", begin=100.0)
    assert east.windows == [FaultWindow(fault="drop", at=2.0, lasts=1.5, share=0.2, toward="host")]
    assert len(file.of("west", begin=100.0).windows) == 2
    assert [east.now("drop", time) for time in (101.9, 102.0, 103.4, 103.5)] == [
        *(False, True, True, False)
    ]


def test_load_faults_reports_every_error_with_its_line(tmp_path: Path) -> None:
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
    message = str(caught.value)
    for line, word in ((2, "dropp"), (3, "mian"), (4, "att"), (5, "share")):
        assert any(f":{line}:" in row and word in row for row in message.splitlines()), message


@pytest.mark.parametrize(
    ("kind", "is_so"),
    [
        ("drop", lambda arrived: arrived == []),
        ("duplicate", lambda arrived: arrived == [(0.0, FRAME)] * 2),
        (
            "truncate",
            lambda arrived: FRAME.startswith(arrived[0][1]) and len(arrived[0][1]) < 40,
        ),
        ("incomplete_set", lambda arrived: len(arrived[0][1]) < 40),
        ("delay", lambda arrived: 0 < arrived[0][0] <= 0.1 and arrived[0][1] == FRAME),
        ("corrupt", lambda arrived: 1 <= flipped_bits(arrived[0][1]) <= 3),
    ],
)
def test_fault_changes_frames_while_active(kind: str, is_so: "object") -> None:
    """Each kind of fault has its effect, only within its window."""
    faults = Faults([FaultWindow(fault=kind, at=1.0, lasts=1.0)], begin=10.0, seed=3)
    assert is_so(faults.pass_on(FRAME, toward="amplifier", time=11.5))
    for time in (10.5, 12.0):
        assert faults.pass_on(FRAME, toward="amplifier", time=time) == [(0.0, FRAME)]


def flipped_bits(data: bytes) -> int:
    """How many bits differ from the frame."""
    return sum((a ^ b).bit_count() for a, b in zip(data, FRAME, strict=True))


def test_fault_hits_a_share_of_one_direction() -> None:
    """A fifth of the frames to the host; the same seed hits the same ones."""
    runs = []
    for _ in range(2):
        faults = Faults([FaultWindow(fault="drop", share=0.2, toward="host")], seed=5)
        runs.append([bool(faults.pass_on(FRAME, toward="host", time=1.0)) for _ in range(2000)])
    assert runs[0] == runs[1]
    assert 0.17 < runs[0].count(False) / 2000 < 0.23
    assert faults.pass_on(FRAME, toward="amplifier", time=1.0)


@pytest.mark.parametrize("is_closed", [False, True])
def test_line_delivers_frames_at_its_speed_until_closed(is_closed: bool) -> None:
    """At 10 kbit/s forty bytes of ten bits take 40 ms; frames in flight are lost on closing.

    They come in pieces of at most 10 ms.
    """

    async def arrivals() -> list[float]:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, SteppedLoop)
        arrived: list[float] = []
        line = Line(
            lambda data, now: arrived.append(loop.time()),
            toward="host",
            faults=Faults(),
            byte_time=1e-3,
        )
        line.send(FRAME)
        line.send(FRAME)
        await loop.step(0.06)
        if is_closed:
            line.close()
        await loop.step(0.1)
        return arrived

    with asyncio.Runner(loop_factory=SteppedLoop) as runner:
        arrived = runner.run(arrivals())
    pieces = [0.01 * number for number in range(1, 7 if is_closed else 9)]
    assert arrived == pytest.approx(pieces, abs=STEP)


def test_faults_combine_on_one_frame() -> None:
    """A frame truncated to nothing does not arrive."""
    kinds: tuple[FaultKind, ...] = ("truncate", "truncate", "corrupt", "incomplete_set")
    faults = Faults([FaultWindow(fault=kind) for kind in kinds])
    arrived = [faults.pass_on(b"ab", toward="amplifier", time=1.0) for _ in range(200)]
    assert {len(data) for frames in arrived for _, data in frames} <= {1}
    assert [] in arrived


@pytest.mark.parametrize("kind", ["corrupt", "truncate", "incomplete_set"])
def test_wire_that_finds_damage_loses_the_frame(kind: FaultKind) -> None:
    """As TCP does; what is only late or double arrives."""
    for fault, expected in ((kind, []), ("duplicate", [(0.0, FRAME)] * 2)):
        faults = Faults((FaultWindow(fault=fault),))  # type: ignore[arg-type]
        arrived = faults.pass_on(FRAME, toward="amplifier", time=1.0, finds_damage=True)
        assert arrived == expected
