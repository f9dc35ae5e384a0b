"""A plate on the desk behind a sound card, measured with one sensor that is moved.

And through PortAudio over a real JACK server, with rejected and lost devices. PortAudio keeps to
one server in a process, so commands use it.
"""

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import LinkError
from era_haptics.command import run_era
from era_haptics.lab.measuring.desk import Desk
from era_haptics.lab.measuring.measure import measure_through
from era_haptics.lab.measuring.multisine import Multisine
from era_haptics.lab.measuring.sensor_file import WiredSensor, read_sensors
from era_haptics.lab.measuring.sound_card import DeviceLost
from kit.desk_plate import Converters, DeskModel, DeskPlate, Truth
from model.arrays import Float32Array, FloatArray
from model.errors import InputError
from model.estimate.measurement import MeasuredPlate
from model.response_files import measurement_of, read_measured
from model.rig.rig import Rig
from model.rig.rig_file import example_rig_path
from processes.gateways import wait_for
from processes.installed import ERA
from processes.interrupted import full_disk
from processes.jack_recorder import Capture
from processes.sound_cards import JackServer, jack_server
from tests.era_haptics.lab.measuring.card_in_memory import DeskCard

RATE = 8_000.0
LEVEL = 0.3

# A JACK server

DESK = Path(__file__).parents[4] / "examples" / "desk"
OUTPUTS = 5  # of that desk: four ERAs and the loop-back


def rejected(server: JackServer, *arguments: str) -> tuple[int, str]:
    """Return the exit status and the message of a command that prints nothing else."""
    completed = subprocess.run(
        [ERA, *arguments],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        env=server.environment,
        check=False,
    )
    assert completed.stdout == ""
    return completed.returncode, completed.stderr


def rejected_measurement(server: JackServer, device: str, folder: Path) -> tuple[int, str]:
    """Return the exit status of a measurement and its message, which is a single line."""
    rig, sensors = str(DESK / "rig.yaml"), str(DESK / "sensors.csv")
    files = ["--sensors", sensors, "-o", str(folder / "m.csv")]
    status, message = rejected(server, "measure", rig, "--device", device, *files)
    assert message.count("\n") == 1
    return status, message


@pytest.mark.real_time
@pytest.mark.needs("jackd", "portaudio", "cc")
def test_unsuitable_card_is_rejected(tmp_path: Path) -> None:
    """No such device, no inputs, too few outputs: one message, exit status 2, and no file."""
    causes = {
        "card, JACK": "13 inputs, got 0",
        "system, JACK": "5 outputs, got 4",
        "no such device": "no such device",
        "jack:card": '"CLIENT, JACK"',
    }
    name = f"card{os.getpid()}"
    with jack_server(name, outputs=OUTPUTS - 1, inputs=13) as server:
        capture = Capture(name, "card", OUTPUTS)
        for device, cause in causes.items():
            status, message = rejected_measurement(server, device, tmp_path)
            assert status == 2
            assert cause in message
        capture.close()

    assert list(tmp_path.iterdir()) == []


@pytest.mark.real_time
@pytest.mark.needs("jackd", "portaudio", "cc")
def test_measurement_ends_with_its_server(tmp_path: Path) -> None:
    """Ended while a run plays: one message, not that of a timeout, exit status 3, and no file."""
    name = f"lost{os.getpid()}"
    with jack_server(name, inputs=13, outputs=OUTPUTS) as server:
        capture = Capture(name, "looking", 1)  # once the server is up
        with ThreadPoolExecutor() as thread:
            measurement = thread.submit(rejected_measurement, server, "system, JACK", tmp_path)
            wait_for(lambda: capture.is_played_to(f"system:playback_{OUTPUTS}"))
            capture.close()  # libjack does not bear to close a client of a server that has ended
            server.process.terminate()  # one that is killed occupies one of JACK's eight places
            status, message = measurement.result()

    assert status == 3
    assert "lost" in message
    assert "took no sample" not in message
    assert list(tmp_path.iterdir()) == []


# Fixed sensors

PLACES = ((0.03, 0.05), (0.20, 0.11), (0.29, 0.20), (0.11, 0.19), (0.25, 0.03))
SENSORS = tuple(
    WiredSensor(f"P{number}", *place, number, 2e-3) for number, place in enumerate(PLACES, start=1)
)


def measured(rig: Rig, truth: Truth, **wires: object) -> MeasuredPlate:
    """Measure the plate from rest."""
    converters = Converters(delay=73, noise=5e-3)
    plate = DeskPlate(truth, SENSORS, rate=RATE, converters=converters, seed=1)
    card = DeskCard(plate, rate=RATE, **wires)  # type: ignore[arg-type]
    multisine = Multisine(np.array([61.0, 151.0, 311.0]), len(rig.eras) + 1, RATE, LEVEL)
    desk = Desk(rig, SENSORS)
    return measure_through(desk, card, multisine, periods=2, progress=lambda done, total: None)


def compress(played: FloatArray, run: int) -> FloatArray:
    """Return the output of amplifiers that compress."""
    return np.asarray(played * (1 - 0.1 * (played / LEVEL) ** 2))


def fade(played: FloatArray, run: int) -> FloatArray:
    """Return the output of amplifiers that are softer in the last run."""
    return np.asarray(played * (0.97 if run == 6 else 1.0))


@pytest.mark.parametrize(("amplify", "cause"), [(compress, "half the level"), (fade, "at the end")])
def test_plate_that_is_not_the_same_twice_is_refused(
    rig: Rig, truth: Truth, amplify: Callable[[FloatArray, int], FloatArray], cause: str
) -> None:
    """Compression shows at half the level, fading in the last run."""
    plate = measured(rig, truth, amplified=amplify)

    with pytest.raises(InputError, match=cause):
        plate.measurement.check()


def test_block_that_is_lost_in_a_repeated_run_is_played_again(rig: Rig, truth: Truth) -> None:
    """Once is repeated, three times is refused."""
    measured(rig, truth, lost=[5]).measurement.check()

    with pytest.raises(LinkError):
        measured(rig, truth, lost=[6, 7, 8])


# A sensor that is moved

GRAMS = 5.0
THREE_PLACES = {"P1": (0.03, 0.05), "P2": (0.20, 0.11), "P3": (0.29, 0.20)}
FREQUENCIES = np.array([61.0, 141.0, 221.0, 301.0])
HEAD = "sensor,x_m,y_m,input,mv_per_m_s2,mass_g\n"
GO_ON = "go on with --resume"


class PulledCard(DeskCard):
    """A card whose plug is pulled in a run, or whose output 1 is muted from a run on."""

    pulled: int | None = None
    muted: int | None = None
    closed = 0

    def run(self, played: FloatArray) -> Float32Array:
        """Advance the plate, or raise DeviceLost."""
        if self.runs == self.pulled:
            raise DeviceLost("memory: the device was lost, or takes no samples")
        if self.muted is not None and self.runs >= self.muted:
            played = played * (np.arange(played.shape[1]) != 0)
        return super().run(played)

    def close(self) -> None:
        """Count."""
        self.closed += 1


class Bench:
    """The command with a plate in memory, and a person who moves its sensor as it asks."""

    def __init__(
        self,
        truth: Truth,
        patch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
        *,
        output: str = "measured.uff",
        noise: float = 5e-3,
        **wires: object,
    ) -> None:
        self.output = Path(output)
        self.stays = [""]
        """Places to which the person does not move the sensor."""
        self.errors = ""
        self.text = ""
        self._capsys = capsys
        self._keys: list[str] = []
        Path("rig.yaml").write_text(example_rig_path().read_text("utf-8"), "utf-8")
        rows = [f"{name},{x},{y},1,2,{GRAMS}\n" for name, (x, y) in THREE_PLACES.items()]
        Path("sensors.csv").write_text(HEAD + "".join(rows), "utf-8-sig")
        sensors = read_sensors(Path("sensors.csv"), truth.rig.plate, may_move=True)
        converters = Converters(delay=73, noise=noise)
        self._plate = DeskPlate(truth, sensors, rate=RATE, converters=converters, seed=1)
        self.card = PulledCard(self._plate, rate=RATE, **wires)  # type: ignore[arg-type]
        patch.setattr("era_haptics.lab.measuring.measure.open_card", lambda *_, **__: self.card)
        patch.setattr(sys, "stdin", self)

    def readline(self) -> str:
        """Move the sensor as the command asks, and press the next key; end the input after it."""
        self.errors += self._capsys.readouterr().err
        if not self._keys:
            return ""
        key = self._keys.pop(0)
        if key == "Ctrl-C":
            raise KeyboardInterrupt
        place = self.errors.rpartition("sensor at ")[2].split(",")[0]
        if place in self.stays:
            self.stays.remove(place)
        else:
            self._plate.move_sensor(place)
        return f"{key}\n"

    def measure(self, *options: str, keys: Sequence[str] = ()) -> int:
        """Return the exit status of a measurement with these keys."""
        self._keys = [*keys]
        self.errors = ""
        files = ["--sensors", "sensors.csv", "-o", str(self.output)]
        command = ["measure", "rig.yaml", "--device", "memory", *files]
        status = run_era([*command, "--frequencies", "61:301:80", *options])
        self.text, errors = self._capsys.readouterr()
        self.errors += errors
        return status

    def places(self, *options: str, keys: Sequence[str]) -> dict[str, list[str]]:
        """Return the places that were measured with these keys, and those that are missing."""
        assert self.measure("--json", *options, keys=keys) == 0
        return json.loads(self.text)["places"]  # type: ignore[no-any-return]


MakeBench = Callable[..., Bench]


@pytest.fixture
def make_bench(
    truth: Truth,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> MakeBench:
    """Make a bench in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return lambda **options: Bench(truth, monkeypatch, capsys, **options)


def test_each_place_is_measured_under_the_sensors_mass(
    rig: Rig, truth: Truth, make_bench: MakeBench
) -> None:
    """Against the plate's closed form with the mass at that place alone; the file has it.

    5 g change responses by several percent, so the bare plate can be distinguished.
    """
    bench = make_bench()

    assert bench.measure(keys=["", "", ""]) == 0

    assert "x 30 mm, y 50 mm (place 1 of 3)" in bench.errors
    assert "Next: era calibrate rig.yaml measured.uff" in bench.text
    measurement = measurement_of(read_measured(bench.output), rig)
    model = DeskModel(truth, np.array([*THREE_PLACES.values()]))
    strokes = np.array([corner.stroke for corner in rig.eras])
    bare = model.under().response(FREQUENCIES) / strokes
    for number, name in enumerate(THREE_PLACES):
        loaded = model.under(moved=(number, GRAMS / 1e3)).response(FREQUENCIES)
        expected = loaded[:, 0] / strokes
        values = measurement.values[:, measurement.names.index(name)]
        error = np.linalg.norm(values - expected)
        assert error < 0.02 * np.linalg.norm(expected), name
        assert np.linalg.norm(values - bare[:, number]) > 2 * error, name
    masses = [sensor.mass for sensor in measurement.sensors]
    assert masses == pytest.approx([GRAMS / 1e3] * 3)


@pytest.mark.parametrize("ending", ["uff", "csv"])
def test_stopped_measurement_is_resumed(make_bench: MakeBench, ending: str) -> None:
    """Stopped at the end of the input, by Ctrl-C and by a pulled card: each reports its places.

    The others are measured with --resume, which is required, and no place twice.
    """
    bench = make_bench(output=f"measured.{ending}")
    of_three = f"of 3 places are measured, in measured.{ending}"

    assert bench.measure(keys=[""]) == 0
    assert bench.card.closed == 1
    assert f"1 {of_three}; {GO_ON}" in bench.text
    assert "calibrate" not in bench.text

    assert bench.measure() == 2
    assert f"exists; {GO_ON}" in bench.errors

    assert bench.measure("--resume", keys=["", "Ctrl-C"]) == 130
    assert bench.errors.rstrip().endswith(f"2 {of_three}; {GO_ON}")

    content = bench.output.read_bytes()
    bench.card.pulled = bench.card.runs + 2
    assert bench.measure("--resume", keys=[""]) == 3
    last_line = bench.errors.splitlines()[-1]
    assert last_line.count("lost") == 1
    assert f"2 {of_three}" in last_line
    assert bench.output.read_bytes() == content

    bench.card.pulled = None
    assert bench.places("--resume", keys=[""]) == {"measured": ["P3"], "missing": []}
    assert json.loads(bench.text)["sensors"]["P3"]["coherence_min"] > 0.9
    assert {row.sensor for row in read_measured(bench.output)} == set(THREE_PLACES)


def test_measurement_that_was_not_started_is_not_resumed(make_bench: MakeBench) -> None:
    """There is no file."""
    bench = make_bench()

    assert bench.measure("--resume") == 2

    assert "to go on from" in bench.errors


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        (["--level", "0.2"], "setting must be level 0.2"),
        (["--frequencies", "61:301:120"], "frequencies must be 3"),
        (["--sensor-mass", "1"], "sensor 1 g, .* got level 0.3, sensor 5 g"),
    ],
)
def test_measurement_with_other_options_is_not_resumed(
    make_bench: MakeBench, options: list[str], cause: str
) -> None:
    """Another level, frequency and mass."""
    bench = make_bench()
    bench.measure(keys=[""])

    assert bench.measure("--resume", *options) == 2

    assert re.search(cause, bench.errors)


def test_place_that_cannot_be_written_is_not_counted(make_bench: MakeBench) -> None:
    """On a full disk an error states the content of the file, the first place only."""
    bench = make_bench(output="measured.csv")
    bench.measure(keys=[""])
    content = bench.output.read_bytes()

    with full_disk(at=16):
        assert bench.measure("--resume", keys=["", ""]) == 2

    last_line = bench.errors.splitlines()[-1]
    expected = "measured.csv: cannot be written: File too large; 1 of 3 places are measured"
    assert expected in last_line
    assert bench.output.read_bytes() == content


def test_place_is_repeated_or_skipped(make_bench: MakeBench) -> None:
    """r measures the last one again, s omits one, other keys and an early r do nothing."""
    bench = make_bench()

    places = bench.places(keys=["r", "x", "", "r", "", "s", ""])

    assert places == {"measured": ["P1", "P3"], "missing": ["P2"]}
    assert bench.card.runs == 15


def test_sensor_that_was_not_moved_is_noticed(make_bench: MakeBench) -> None:
    """Its response is that of the previous place; after another request it is moved."""
    bench = make_bench()
    bench.stays = ["P2"]

    places = bench.places(keys=["", "", "", ""])

    assert places["measured"] == ["P1", "P2", "P3"]
    assert bench.errors.count("not kept") == 1
    assert "the sensor is still there; move it to P2" in bench.errors


@pytest.mark.parametrize(
    ("muted", "places", "message"),
    [
        (5, ["P1"], "P2 is not kept: output 1 is not heard here"),
        (0, [], "P1 is not kept: output 1 moves not"),
    ],
    ids=["second place", "first place"],
)
def test_output_that_was_heard_elsewhere_is_not_called_dead(
    make_bench: MakeBench, muted: int, places: list[str], message: str
) -> None:
    """Silent from the second place on, it may be on a nodal line, which s skips."""
    bench = make_bench()
    bench.card.muted = muted

    assert bench.places(keys=["", *[""] * len(places)])["measured"] == places

    assert message in bench.errors
    assert ("; s skips it" in bench.errors) == bool(places)


@pytest.mark.parametrize(
    ("wires", "level", "cause"),
    [
        ({"on_inputs": [1, 0]}, "0.3", "silent|swapped|loop-back"),
        ({"gain": 50.0}, "0.3", "clipping"),
        ({"gain": 0.0}, "0.3", "all inputs are silent"),
        ({"noise": 0.01}, "0.001", "higher --level"),
        ({"noise": 0.3}, "0.03", "fix these sensors"),
    ],
    ids=["swapped inputs", "clipped", "no supply", "soft", "loose"],
)
def test_place_that_fails_a_check_is_requested_again(
    make_bench: MakeBench, wires: dict[str, object], level: str, cause: str
) -> None:
    """With its cause, and without a file.

    Noise as loud as the signal is 0.3 % of full scale, or far more: play louder, or fix better.
    """
    bench = make_bench(**wires)

    places = bench.places("--level", level, keys=["", "q"])

    assert places["measured"] == []
    assert bench.errors.count("P1 is not kept") == 1
    assert bench.errors.count("Put the sensor at P1") == 2
    assert re.search(cause, bench.errors)
    assert not bench.output.exists()


# The file of sensors


def test_sensors_are_read_with_their_units(rig: Rig, tmp_path: Path) -> None:
    """A charge of 5 pC/(m/s²), amplified by 2 mV/pC, at 4 V full scale: 2.5e-3 a m/s²."""
    path = tmp_path / "sensors.csv"
    path.write_text("sensor,x_m,y_m,input,mv_per_m_s2,gain,full_scale_v\nP1,0.1,0.2,3,5,2,4\n")

    (sensor,) = read_sensors(path, rig.plate)

    assert (sensor.name, sensor.x, sensor.y, sensor.input) == ("P1", 0.1, 0.2, 3)
    assert sensor.sensitivity == pytest.approx(2.5e-3)


def test_mass_of_a_moved_sensor_is_that_of_the_file_or_the_option(rig: Rig, tmp_path: Path) -> None:
    """The option has priority."""
    path = tmp_path / "sensors.csv"
    path.write_text(HEAD + "P1,0.1,0.1,2,10,2.5\nP2,0.2,0.1,2,10,2.5\n")

    by_file = read_sensors(path, rig.plate, may_move=True)
    by_option = read_sensors(path, rig.plate, may_move=True, mass=1.0)

    assert [sensor.mass for sensor in by_file] == [2.5e-3, 2.5e-3]
    assert [sensor.mass for sensor in by_option] == [1e-3, 1e-3]
