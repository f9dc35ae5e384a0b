"""One contract, run over every backend: what any amplifier must do, whatever its wire."""

import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

import drivers
from drivers.amplifier import Amplifier
from drivers.backend import Backend
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.conformance import CHECKS, Check, Result, raw_line, run_check
from drivers.protocol.messages import AmplifierState, Apply, LoadEnvelope, Stage
from drivers.registry import open_backend
from long_form import shortly
from wires import PROCESS_WIRES, patient

PAPER_PLATE = Path(drivers.__file__).parent.parent / "examples" / "paper_plate.yaml"
SHORT_WIRES = ("sim", "serial", "modbus+tcp", "can+socketcand")
"""The others pass in `make test` in virtual time (test_sound_amplifiers.py)."""

REPLY_TIMEOUT = 2.0  # s; on a busy machine a far end may be late, and is not wrong for it


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The paper's rig on a coarse mesh: the plate takes no part in this contract."""
    text = PAPER_PLATE.read_text(encoding="utf-8")
    assert "mesh: auto" in text
    path = tmp_path_factory.mktemp("rig") / "coarse.yaml"
    path.write_text(text.replace("mesh: auto", "mesh: 12x9"), encoding="utf-8")
    return path


@pytest.fixture(scope="module", params=shortly(["sim", *PROCESS_WIRES], SHORT_WIRES))
def url(request: pytest.FixtureRequest, rig: Path) -> Iterator[str]:
    """An amplifier of the paper's rig behind each kind of wire, as a process where it has one."""
    if request.param == "sim":
        yield f"sim://{rig}"
        return
    with subprocess.Popen(
        [sys.executable, "-P", "-m", "sim", str(rig), *PROCESS_WIRES[request.param]],
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        name, _, url = process.stdout.readline().strip().partition(": ")
        assert name == "main"
        yield patient(url)
        process.terminate()


@pytest.fixture
async def backend(url: str) -> Backend:
    """The backend for that wire, not yet open."""
    return open_backend(url)


@pytest.fixture
async def amplifier(backend: Backend) -> AsyncIterator[Amplifier]:
    """An open amplifier."""
    amplifier = Amplifier(backend, reply_timeout=REPLY_TIMEOUT)
    await amplifier.open()
    yield amplifier
    await amplifier.close()


LONG = {
    *("staged_sets_expire", "ramp_up", "ramp_down", "ramps_of_other_lengths", "interrupted_ramps"),
    *("phases", "earlier_ends_stay", "valid_for", "ramps_of_valid_for", "valid_for_is_of_its_set"),
    *("stop_ramp", "stop_ramp_clipped", "stop_ends_fades", "silence_never_later", "disarm"),
    *("watchdog_times", "watchdog_left", "watchdog_without_reading", "trips_amid_other_requests"),
    *(
        "what_feeds",
        "what_does_not_feed",
        "voices",
        "onsets",
        "endings",
        "skipped_endings",
        "interrupted_endings",
    ),
    *("kept_phase_onset", "loaded_while_playing", "clear_too_early", "arms_again", "fault_list"),
    *("invalid_frames", "invalid_frames_do_not_feed"),
    *("readings_of_tones", "raw_samples", "disturbed_readings", "extreme_steps", "max_knots"),
    *("levels_of_one_frequency", "levels_of_two_frequencies", "phases_of_every_channel"),
    *("arming_ends_fades", "endings_amid_onsets", "no_room_changes_nothing", "max_valid_for"),
    *("watchdog", "watchdog_skips_endings", "trips_amid_fades", "latch_wraps", "every_slot"),
}
"""Checks that last long; over all wires they are run in virtual time."""

SHORT = [check for check in CHECKS if check.name not in LONG]


@pytest.mark.parametrize("url", shortly(["sim", *PROCESS_WIRES], ["serial"]), indirect=True)
@pytest.mark.parametrize("check", SHORT, ids=[check.name for check in SHORT])
async def test_conformance_check_passes(check: Check, amplifier: Amplifier, url: str) -> None:
    """Checks of `era amp conformance`; each says itself what it proves."""
    result = await run_check(check, amplifier, raw_line(url), url=url)
    assert result.result is not Result.FAILED, result


async def test_backend_can_be_reopened(backend: Backend) -> None:
    """The same wire can be opened, used, closed and opened again."""
    for _ in range(2):
        amplifier = Amplifier(backend, reply_timeout=REPLY_TIMEOUT)
        await amplifier.open()
        assert (await amplifier.arm(2.0)).state is AmplifierState.OPERATION_ENABLED
        await amplifier.disarm(0.0)
        await amplifier.close()


async def test_backend_refuses_unchecked_sets_and_envelopes(
    amplifier: Amplifier, backend: Backend
) -> None:
    """TypeError before anything is sent."""
    plain = CommandSet(1, (DriveCommand(0, 110.0, 0.5),), ramp=0.0, valid_for=0.0)
    shape = Envelope(1, 0.005, (Knot(0.5, 0.0),))
    sent = backend.counters.frames_out
    for request in (Stage(plain), Apply(plain), LoadEnvelope(shape)):
        with pytest.raises(TypeError, match="Safe"):
            await backend.exchange(request, timeout=REPLY_TIMEOUT)
    assert backend.counters.frames_out == sent


async def test_backend_counts_frames_and_times_round_trips(
    amplifier: Amplifier, backend: Backend
) -> None:
    """Requests and their replies are counted, a round trip is timed, nothing is called damaged."""
    before = amplifier.statistics
    for _ in range(5):
        await amplifier.heartbeat()
    after = amplifier.statistics
    assert after.frames_out - before.frames_out >= 5
    assert after.frames_in - before.frames_in >= 5
    assert (after.invalid_frames, after.retries) == (before.invalid_frames, before.retries)
    assert after.last_round_trip is not None
    assert backend.wire_times.round_trip(4) >= 0
