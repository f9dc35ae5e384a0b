"""A simulation as a process: its command, its run loop, and its view on a terminal."""

import asyncio
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from controller.cli.main import run
from daemons import SESSION, far_end_process, playing
from drivers.playing import AmplifierTone
from drivers.protocol.definition import QUANTITIES, STATES
from firmware_machine import play
from long_form import shortly
from model.rig.rig import Rig
from model.rig.rig_file import example_rig_path
from plates import write_rig
from recordings import read_recording
from sim.bench.bench import Bench
from sim.control import SimulationContext
from sim.process.simulation import SimulationView, draw

ROOT = example_rig_path().parent.parent
TIMEOUT = 120  # s; for a loaded machine, not an expectation


async def start(arguments: Sequence[str]) -> asyncio.subprocess.Process:
    """Start a simulation as users do."""
    return await asyncio.create_subprocess_exec(
        *(sys.executable, "-P", "-m", "sim", *arguments),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        cwd=ROOT,
    )


async def wait(process: asyncio.subprocess.Process) -> tuple[int, str, str]:
    """Exit status and the rest of both outputs."""
    out, err = await asyncio.wait_for(process.communicate(), TIMEOUT)
    assert process.returncode is not None
    return process.returncode, out.decode(), err.decode()


@pytest.mark.parametrize("is_interrupted", shortly([True, False], [True]))
async def test_sim_serves_until_interrupted_or_eof(is_interrupted: bool) -> None:
    """It prints a URL, serves the amplifier, and exits with status 0 and no files left."""
    with tempfile.TemporaryDirectory() as folder:
        control, link = Path(folder) / "control", Path(folder) / "amp"
        options = ["--serial", "--link", str(link), "--control", str(control), "--until-eof"]
        process = await start([str(example_rig_path()), *options])
        try:
            assert process.stdout is not None
            line = (await asyncio.wait_for(process.stdout.readline(), TIMEOUT)).decode()
            assert line == f"main: serial://{link}?baud=921600\n"
            assert link.readlink().is_char_device()
            assert control.is_socket()
            tone = AmplifierTone(2, 110.0, 0.25)
            async with playing(line.split()[1], tone, watchdog=2.0) as amplifier:
                status = await amplifier.read_status()
            assert (status["state"], status["token"]) == (STATES["OPERATION_ENABLED"], 1)
            assert status["levels"] == [0, 0, QUANTITIES["level"].to_wire(0.25), 0]
        finally:
            if is_interrupted:
                process.send_signal(signal.SIGINT)
            elif process.stdin is not None:
                process.stdin.close()
            ending = await wait(process)
        assert ending == (0, "", "")
        assert not control.exists()
        assert not link.is_symlink()


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        ([str(example_rig_path())], 2, "--serial"),
        (["no_such_rig.yaml", "--serial"], 2, "no_such_rig.yaml"),
        ([str(example_rig_path()), "--serial", "--finger", "0.1"], 2, "--finger"),
        ([str(example_rig_path()), "--serial", "--finger", "9,9"], 2, "finger"),
        ([str(example_rig_path()), "--serial", "--exact", "--seed", "1"], 2, "--seed"),
        ([str(example_rig_path()), "--serial", "--control", "/no/where"], 3, "/no/where"),
        ([str(example_rig_path()), "--serial", "--link", "side=/tmp/x"], 2, "--link"),
        ([str(example_rig_path()), "--serial", "--link", "/no/where"], 2, "/no/where"),
        ([str(example_rig_path()), "--modbus-tcp", "0", "--link", "/tmp/x"], 2, "--link"),
    ],
)
def test_sim_refuses_bad_usage_in_one_line(
    arguments: list[str], status: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit status 2 for input, 3 for the link; one line that names the option or file."""
    assert run(["sim", *arguments]) == status
    out, err = capsys.readouterr()
    assert out == ""
    assert words in err
    assert err.count("\n") == 1


def shown(context: SimulationContext, plate: SimulationView) -> str:
    """The view as text on a usual terminal."""
    console = Console(width=80, force_terminal=False)
    with console.capture() as capture:
        console.print(draw(context, plate))
    return capture.get()


def rows_of(text: str) -> list[str]:
    """The plate's rows, the top one first."""
    return [line[1:-1] for line in text.splitlines() if line.startswith("|")]


def test_view_shows_eras_fingers_and_peaks_in_place(coarse_rig: Rig) -> None:
    """y points upwards; peaks are darkest near the driven ERA; nothing at rest."""
    bench = Bench(coarse_rig, now=0.0)
    context = SimulationContext(bench, urls={"main": "serial:///dev/pts/7?baud=921600"})
    plate = SimulationView(bench)
    bench.probes.append(plate)
    untouched = shown(context, plate).splitlines()
    assert len(untouched) < 24
    assert max(map(len, untouched)) <= 80
    bench.place_fingers({"1": (0.25, 0.05)}, now=0.0)
    still = shown(context, plate)
    rows = rows_of(still)
    assert [row[0] + row[-1] for row in (rows[0], rows[-1])] == ["EE", "EE"]
    # 0.25 of 0.3048 m from the left, 0.05 of 0.2286 m from below.
    assert rows[-1 - int(0.05 / 0.2286 * len(rows))].index("O") == int(0.25 / 0.3048 * 28)
    assert set("".join(rows)) == {"E", "O", " "}
    play(bench, AmplifierTone(0, 40.0, 0.5), now=0.1, watchdog=2.0)
    bench.advance(1.0)
    bench.advance(1.3)
    moving = shown(context, plate)
    assert "OPERATION_ENABLED" in moving
    assert " 50%    0%    0%    0%" in moving
    assert "1.3 s" in moving
    shades = " ·-+*#@"
    depth = np.array([[max(shades.find(c), 0) for c in row] for row in rows_of(moving)])
    # SW, where the drive is, is below on the left.
    assert depth[-3:, :8].mean() > depth[:3, -8:].mean()


async def test_simulation_in_virtual_time_advances_only_by_steps(tmp_path: Path) -> None:
    """Watchdog, faults and recordings follow the steps."""
    rig, file = write_rig(tmp_path / "rig.yaml"), tmp_path / "run.csv"
    async with far_end_process(
        rig, "--serial", "--virtual-time", "--rate", "2000", "--finger", "0.1,0.1"
    ) as far_end:
        hello = await far_end.ask("hello")
        assert (hello["protocol"], hello["version"], hello["clock"]) == (
            "era-sim-control",
            3,
            "virtual",
        )
        assert hello["urls"] == far_end.urls
        assert (await far_end.ask("state"))["time_s"] == 0
        noisy = {"at_m": [0.2, 0.1], "noise_m_s2_rthz": 0.01, "resolution_m_s2": 0.5}
        assert (await far_end.ask("sensors", sensors={"P1": noisy}))["ok"]
        assert (await far_end.ask("record", file=str(file)))["ok"]
        tone = AmplifierTone(0, 110.0, 0.5)
        async with playing(far_end.urls["main"], tone, watchdog=0.5) as amplifier:
            assert await far_end.ask("step", seconds=0.4) == {"ok": True, "time_s": 0.4}
            assert (await far_end.ask("state"))["amplifiers"]["main"]["levels"][0] == 0.5
            assert (await far_end.ask("move", finger="1", at_m=[0.05, 0.05]))["ok"]
            assert (await far_end.ask("touch", finger="2", at_m=[0.2, 0.2]))["ok"]
            assert "2" in (await far_end.ask("touch", finger="2", at_m=[0.2, 0.2]))["error"]
            assert (await far_end.ask("lift", finger="1"))["ok"]
            assert "1" in (await far_end.ask("move", finger="1"))["error"]
            assert (await far_end.ask("state"))["fingers"] == {"2": [0.2, 0.2]}
            tones = await far_end.ask("tones", since_s=0.2, until_s=0.4, frequencies_hz=[110.0])
            assert abs(complex(tones["sensors"]["P1"]["real_m_s2"][0])) > 0
            signals = await far_end.ask("signals", since_s=0.2, until_s=0.4)
            readings = np.array(signals["sensors"]["P1"]["m_s2"])
            assert (signals["sample_rate_hz"], len(readings)) == (2000, 400)
            np.testing.assert_array_equal(readings, 0.5 * np.round(readings / 0.5))
            # The watchdog of 0.5 s expires 0.1 s later.
            assert (await far_end.ask("step", seconds=0.09)) == {"ok": True, "time_s": 0.49}
            assert (await far_end.ask("state"))["amplifiers"]["main"]["fault"] == "NONE"
            await far_end.ask("step", seconds=0.51)
            assert (await far_end.ask("state"))["amplifiers"]["main"]["fault"] == "WATCHDOG"
            await amplifier.read_status()
            await amplifier.clear()
            await amplifier.arm(SESSION + 1, 0.5)
            assert (await far_end.ask("inject_fault", fault="arc", amplifier="main"))["ok"]
            assert (await far_end.ask("state"))["amplifiers"]["main"]["fault"] == "ARC"
            begin = (await far_end.ask("state"))["time_s"]
            assert (await far_end.ask("faults"))["faults"]["main"] == [
                {"fault": "arc", "begin_s": begin, "end_s": None, "is_on": True}
            ]
            assert (await far_end.ask("recover"))["ok"]
            assert (await far_end.ask("faults")) == {"faults": {"main": []}}
            unknown = await far_end.ask("inject_fault", fault="arc", amplifier="x")
            assert "amplifier" in unknown["error"]
            assert "share" in (await far_end.ask("inject_fault", fault="drop", share=2))["error"]
            assert "seconds" in (await far_end.ask("step", seconds=-1))["error"]
        assert not file.exists()
        finished = await far_end.ask("finish")
        assert finished == {"file": str(file), "seconds": 1.0, "is_full": False}
        assert (await far_end.ask("finish")).keys() == {"error"}
        assert (await far_end.end())[0] == 0
    recording = read_recording(file)
    assert recording.names == ("P1", "finger_1")
    assert (recording.start, recording.samples.shape) == (0.0005, (2000, 2))


@pytest.mark.long
async def test_simulation_applies_a_fault_within_a_step_at_its_time(tmp_path: Path) -> None:
    """Half a second into a step of 0.8 s the fault silences the amplifier, not before."""
    async with (
        far_end_process(
            write_rig(tmp_path / "rig.yaml"), "--serial", "--virtual-time", "--sensor", "P1=0.0,0.0"
        ) as far_end,
        playing(far_end.urls["main"], AmplifierTone(0, 110.0, 0.5), watchdog=2.0),
    ):
        await far_end.ask("inject_fault", fault="over_temperature", lasts=1.0)
        await far_end.ask("step", seconds=0.8)
        assert (await far_end.ask("state"))["amplifiers"]["main"]["fault"] == "OVER_TEMPERATURE"
        signals = await far_end.ask("signals", since_s=0.3, until_s=0.8)
    strength = np.abs(np.reshape(signals["sensors"]["P1"]["m_s2"], (5, 1000))).max(axis=1)
    assert strength[1] == pytest.approx(strength[0], rel=0.1)  # 0.3 to 0.5 s
    assert strength[3] < 0.5 * strength[1]  # from 0.6 s on it only rings down


@pytest.mark.parametrize("number", shortly([signal.SIGTERM, signal.SIGHUP], [signal.SIGTERM]))
async def test_simulation_writes_its_recording_on_a_signal(
    tmp_path: Path, number: signal.Signals
) -> None:
    """SIGTERM and SIGHUP write the file and print its name."""
    file = tmp_path / "run.wav"
    async with far_end_process(
        write_rig(tmp_path / "rig.yaml"),
        *("--modbus-tcp", "0", "--sensor", "P1=0.1,0.1", "--record", str(file)),
    ) as far_end:
        assert "--virtual-time" in (await far_end.ask("step", seconds=1))["error"]
        assert "frequencies_hz" in (await far_end.ask("tones", since_s=0, until_s=1))["error"]
        status, printed = await far_end.end(number)
    assert status == 0
    assert str(file) in printed
    assert read_recording(file).names == ("P1",)
    assert not far_end.control.exists()


@pytest.mark.parametrize("after", [0.1, 0.4])
async def test_simulation_exits_on_a_signal_while_it_starts(tmp_path: Path, after: float) -> None:
    """It exits without a traceback."""
    import asyncio
    import sys

    for command in (["-m", "sim"], ["-c", "from controller.cli.main import main; main()", "sim"]):
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-P", *command, str(write_rig(tmp_path / "rig.yaml")), "--serial"),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        await asyncio.sleep(after)
        process.terminate()
        _, err = await asyncio.wait_for(process.communicate(), 30)
        # -SIGINT: CPython exits so where the signal interrupts an exec(), as of dataclasses.
        assert process.returncode in (0, 130, -signal.SIGTERM, -signal.SIGINT)
        assert err == b""
