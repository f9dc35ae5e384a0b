"""A plate or board on the desk behind a sound card: measured, and identified.

In time against a direct solution; with one sensor that is moved, its mass and its file; and through
PortAudio over a real JACK server, with what they reject and lose. PortAudio keeps to one server in
a process, so that commands use it.
"""

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
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
from kit.desk_plate import (
    Converters,
    DeskModel,
    DeskPlate,
    Truth,
)
from model.arrays import Float32Array, FloatArray
from model.errors import InputError
from model.estimate.measurement import MeasuredPlate
from model.response_files import measurement_of, read_measured
from model.rig.rig import Rig
from model.rig.rig_file import example_rig_path, parse_rig
from model.structure.attachments import PointLoad
from processes.gateways import wait_for
from processes.interrupted import full_disk
from processes.jack_recorder import Capture
from processes.sound_cards import DeskCard, JackServer, jack_server
from processes.typed_page import ERA

BOARD = """
plate: {length: 300 mm, width: 230 mm, thickness: 5 mm, loss_factor: 0.01,
  material: {E: 4.5 GPa, rho: 1190, nu: 0.37}}
mesh: auto
eras:
  SW: {kind: exciter, type: DAEX25FHE-4, at: [54 mm, 55 mm], amplifier: card, channel: 0}
  SE: {kind: exciter, type: DAEX25FHE-4, at: [237 mm, 39 mm], amplifier: card, channel: 1}
  NE: {kind: exciter, type: DAEX25FHE-4, at: [252 mm, 179 mm], amplifier: card, channel: 2}
  NW: {kind: exciter, type: DAEX25FHE-4, at: [81 mm, 186 mm], amplifier: card, channel: 3}
amplifiers:
  card: {url: "serial:///tmp/plate", full_level: output}
limits: {frequency: [40 Hz, 300 Hz], level: 1.0}
"""
FEET = tuple(
    PointLoad(x, y, stiffness=2000.0, damping=2.0, foot=5e-3)
    for x in (0.01, 0.29)
    for y in (0.01, 0.22)
)


@pytest.fixture(scope="module")
def board() -> Rig:
    """Acrylic on feet of foam, with four exciters."""
    return replace(parse_rig("board.yaml", BOARD), masses=FEET)


DESK = Path(__file__).parents[4] / "examples" / "desk"
CHANNELS = 5  # of that desk: four ERAs and the loop-back


def refusal(server: JackServer, *arguments: str) -> tuple[int, str]:
    """Exit status and message of a command."""
    done = subprocess.run(
        [ERA, *arguments],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        env=server.environment,
        check=False,
    )
    assert done.stdout == ""
    return done.returncode, done.stderr


def measure(server: JackServer, device: str, folder: Path) -> tuple[int, str]:
    """Exit status and message of a measurement that is refused."""
    sensors, found = str(DESK / "sensors.csv"), str(folder / "m.csv")
    return refusal(
        server, "measure", str(DESK / "rig.yaml"), "--device", device, "--sensors", sensors,
        "-o", found,
    )  # fmt: skip


@pytest.mark.real_time
@pytest.mark.needs("jackd", "portaudio", "cc")
def test_unsuitable_card_is_rejected(tmp_path: Path) -> None:
    """No such device, no inputs, too few outputs: one message, exit status 2, and no file."""
    name = f"card{os.getpid()}"
    with jack_server(name, outputs=CHANNELS - 1, inputs=13) as server:
        capture = Capture(name, "card", CHANNELS)
        for device, cause in (
            ("card, JACK", "13 inputs, got 0"),
            ("system, JACK", "5 outputs, got 4"),
            ("no such device", "no such device"),
            ("jack:card", '"CLIENT, JACK"'),
        ):
            status, message = measure(server, device, tmp_path)
            assert (status, message.count("\n")) == (2, 1)
            assert cause in message
        assert not any(tmp_path.iterdir())
        capture.close()


@pytest.mark.real_time
@pytest.mark.needs("jackd", "portaudio", "cc")
def test_measurement_without_its_server_is_lost(tmp_path: Path) -> None:
    """Ended while a run plays: one message, not that of a timeout, exit status 3, and no file."""
    name = f"lost{os.getpid()}"
    with jack_server(name, inputs=13, outputs=CHANNELS) as server:
        looking = Capture(name, "looking", 1)  # once the server is up
        with ThreadPoolExecutor() as thread:
            measuring = thread.submit(measure, server, "system, JACK", tmp_path)
            wait_for(lambda: looking.is_played_to(f"system:playback_{CHANNELS}"))
            looking.close()  # libjack does not bear to close a client of a server that is gone
            server.process.terminate()  # one that is killed occupies one of JACK's eight places
            status, message = measuring.result()
        assert (status, message.count("\n"), "lost" in message) == (3, 1, True)
        assert "took no sample" not in message
    assert not any(tmp_path.iterdir())


@pytest.mark.real_time
@pytest.mark.needs("jackd", "portaudio")
def test_rate_that_gives_no_whole_milliseconds_is_rejected_for_an_amplifier() -> None:
    """44.1 kHz of a server; a measurement takes any rate."""
    name = f"rate{os.getpid()}"
    with jack_server(name, rate=44_100) as server:
        Capture(name, "looking", 1).close()  # once the server is up
        status, message = refusal(server, "soft-amp", "--device", "system", "--channels", "2")
        assert (status, "multiple of 1000 Hz" in message, "44100 Hz" in message) == (2, True, True)


CARD_RATE, LEVEL = 8_000.0, 0.3
PLACES = ((0.03, 0.05), (0.20, 0.11), (0.29, 0.20), (0.11, 0.19), (0.25, 0.03))
SENSORS = tuple(WiredSensor(f"P{n}", x, y, n, 2e-3) for n, (x, y) in enumerate(PLACES, start=1))
LINES = np.arange(51.0, 500.0, 40.0)


def measured(
    rig: Rig,
    truth: Truth,
    *,
    frequencies: FloatArray = LINES,
    **wires: object,
) -> MeasuredPlate:
    """The plate measured from rest."""
    converters = Converters(delay=73, noise=5e-3)
    plate = DeskPlate(truth, SENSORS, rate=CARD_RATE, converters=converters, seed=1)
    card = DeskCard(plate, rate=CARD_RATE, **wires)  # type: ignore[arg-type]
    desk = Desk(rig, SENSORS)
    multisine = Multisine(frequencies, len(rig.eras) + 1, CARD_RATE, LEVEL)
    return measure_through(desk, card, multisine, periods=2, progress=lambda done, of: None)


@pytest.mark.parametrize(
    ("amplified", "cause"),
    [
        (lambda played, run: played * (1 - 0.1 * (played / LEVEL) ** 2), "half the level"),
        (lambda played, run: played * (0.97 if run == 6 else 1.0), "at the end"),
    ],
    ids=["compressed", "faded"],
)
def test_plate_that_is_not_the_same_twice_is_refused(
    rig: Rig, truth: Truth, amplified: object, cause: str
) -> None:
    """Amplifiers that compress show at half the level, ones that fade in the run that is last."""
    few = np.array([61.0, 151.0, 311.0])
    found = measured(rig, truth, frequencies=few, amplified=amplified)
    with pytest.raises(InputError, match=cause):
        found.measurement.check()


def test_block_that_is_lost_in_a_repeated_run_is_played_again(rig: Rig, truth: Truth) -> None:
    """Once is repeated, three times is refused."""
    few = np.array([61.0, 151.0, 311.0])
    measured(rig, truth, frequencies=few, lost=[5]).measurement.check()
    with pytest.raises(LinkError):
        measured(rig, truth, frequencies=few, lost=[6, 7, 8])


MOVED_SENSOR_RATE, GRAMS = 8_000.0, 5.0
Places = Mapping[str, tuple[float, float]]
MOVED_SENSOR_PLACES: Places = {"P1": (0.03, 0.05), "P2": (0.20, 0.11), "P3": (0.29, 0.20)}
MOVED_HZ = np.array([61.0, 141.0, 221.0, 301.0])
HEAD = "sensor,x_m,y_m,input,mv_per_m_s2,mass_g\n"


KEPT = "of 3 places are measured, in measured"
GO_ON = "go on with --resume"


class PulledCard(DeskCard):
    """Its plug is pulled in the run of that number, if any; muted: output 1 is, from that run."""

    pulled: int | None = None
    muted: int | None = None
    closed = 0

    def run(self, played: FloatArray) -> Float32Array:
        """Advance the plate, or be gone."""
        if self.runs == self.pulled:
            raise DeviceLost("memory: the device was lost, or takes no samples")
        if self.muted is not None and self.runs >= self.muted:
            played = played * (np.arange(played.shape[1]) != 0)
        return super().run(played)

    def close(self) -> None:
        """Count."""
        self.closed += 1


class Bench:
    """The command with a plate in memory, and the person who moves its sensor as it says.

    stays: places to which the person does not move it; said, out: standard error and output.
    """

    def __init__(
        self,
        truth: Truth,
        patch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
        *,
        output: str = "measured.uff",
        places: Places = MOVED_SENSOR_PLACES,
        grams: float = GRAMS,
        noise: float = 5e-3,
        **wires: object,
    ) -> None:
        self.output, self._capsys, self.stays, self.said, self.out = output, capsys, [""], "", ""
        self._keys: list[str] = []
        Path("rig.yaml").write_text(example_rig_path().read_text("utf-8"), "utf-8")
        rows = [f"{name},{x},{y},1,2,{grams}\n" for name, (x, y) in places.items()]
        Path("sensors.csv").write_text(HEAD + "".join(rows), "utf-8-sig")
        sensors = read_sensors(Path("sensors.csv"), truth.rig.plate, may_move=True)
        converters = Converters(delay=73, noise=noise)
        self._plate = DeskPlate(
            truth, sensors, rate=MOVED_SENSOR_RATE, converters=converters, seed=1
        )
        self.card = PulledCard(self._plate, rate=MOVED_SENSOR_RATE, **wires)  # type: ignore[arg-type]
        patch.setattr("era_haptics.lab.measuring.measure.open_card", lambda *_, **__: self.card)
        patch.setattr(sys, "stdin", self)

    def readline(self) -> str:
        """Move the sensor as was said, and press the next key; nothing at their end."""
        self.said += self._capsys.readouterr().err
        if not self._keys:
            return ""
        key = self._keys.pop(0)
        if key == "Ctrl-C":
            raise KeyboardInterrupt
        place = self.said.rpartition("sensor at ")[2].split(",")[0]
        if place in self.stays:
            self.stays.remove(place)
        else:
            self._plate.move_sensor(place)
        return f"{key}\n"

    def measure(self, *more: str, keys: Sequence[str] = ()) -> int:
        """Exit status of a measurement with these keys."""
        self._keys, self.said = [*keys], ""
        words = ["measure", "rig.yaml", "--device", "memory", "--sensors", "sensors.csv", "-o"]
        status = run_era([*words, self.output, "--frequencies", "61:301:80", *more])
        self.out, said = self._capsys.readouterr()
        self.said += said
        return status

    def measured(self, *more: str, keys: Sequence[str]) -> dict[str, list[str]]:
        """Places that were measured with these keys, and those that are missing."""
        assert self.measure("--json", *more, keys=keys) == 0
        return json.loads(self.out)["places"]  # type: ignore[no-any-return]


Make = Callable[..., Bench]


@pytest.fixture
def make(
    truth: Truth,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> Make:
    """Make a bench; all is as it should be unless told otherwise."""
    monkeypatch.chdir(tmp_path)
    return lambda **options: Bench(truth, monkeypatch, capsys, **options)


def test_each_place_is_measured_under_the_sensors_mass(rig: Rig, truth: Truth, make: Make) -> None:
    """Against the plate's closed form with the mass at that place alone; the file has all of it.

    5 g change responses by several percent, so that the bare plate can be distinguished from it.
    """
    bench = make()
    assert bench.measure(keys=["", "", ""]) == 0
    assert "x 30 mm, y 50 mm (place 1 of 3)" in bench.said
    assert "Next: era calibrate rig.yaml measured.uff" in bench.out
    found = measurement_of(read_measured(Path(bench.output)), rig)
    model = DeskModel(truth, np.array([*MOVED_SENSOR_PLACES.values()]))
    strokes = np.array([era.stroke for era in rig.eras])
    bare = model.under().response(MOVED_HZ) / strokes
    for n, name in enumerate(MOVED_SENSOR_PLACES):
        one = model.under(moved=(n, GRAMS / 1e3)).response(MOVED_HZ)[:, 0] / strokes
        measured = found.values[:, found.names.index(name)]
        wrong = np.linalg.norm(measured - one) / np.linalg.norm(one)
        assert wrong < 0.02
        assert np.linalg.norm(measured - bare[:, n]) / np.linalg.norm(one) > 2 * wrong
    assert [each.mass for each in found.sensors] == pytest.approx([GRAMS / 1e3] * 3)


@pytest.mark.parametrize("ending", ["uff", "csv"])
def test_measurement_that_was_stopped_goes_on(make: Make, ending: str) -> None:
    """Stopped at the end of the input, by Ctrl-C and by a pulled card: each says what is kept.

    The rest is measured with --resume, which is needed for that, and no place twice.
    """
    bench = make(output=f"measured.{ending}")
    assert (bench.measure(keys=[""]), bench.card.closed) == (0, 1)
    assert f"1 {KEPT}.{ending}; {GO_ON}" in bench.out
    assert "calibrate" not in bench.out
    assert (bench.measure(), f"exists; {GO_ON}" in bench.said) == (2, True)
    assert bench.measure("--resume", keys=["", "Ctrl-C"]) == 130
    assert bench.said.rstrip().endswith(f"2 {KEPT}.{ending}; {GO_ON}")
    before = Path(bench.output).read_bytes()
    bench.card.pulled = bench.card.runs + 2
    assert bench.measure("--resume", keys=[""]) == 3
    last = bench.said.splitlines()[-1]
    assert (last.count("lost"), f"2 {KEPT}" in last) == (1, True)
    assert Path(bench.output).read_bytes() == before
    bench.card.pulled = None
    assert bench.measured("--resume", keys=[""]) == {"measured": ["P3"], "missing": []}
    assert json.loads(bench.out)["sensors"]["P3"]["coherence_min"] > 0.9
    assert {each.sensor for each in read_measured(Path(bench.output))} == set(MOVED_SENSOR_PLACES)


def test_files_of_another_measurement_are_not_gone_on_with(make: Make) -> None:
    """Another level, frequency, mass, place and rig, each by its name; before it is none to go on.

    A mass in other units is refused.
    """
    bench = make()
    for more, cause in (
        (["--resume"], "to go on from"),
        (["--sensor-mass", "900"], "mass_g must be from 0"),
    ):
        assert bench.measure(*more) == 2
        assert cause in bench.said
    bench.measure(keys=[""])
    changes = {
        "sensors.csv": ("0.03,", "0.04,"),
        "rig.yaml": ("loss_factor: 0.01", "loss_factor: 0.02"),
    }
    for more, cause in (
        (["--level", "0.2"], "setting must be level 0.2"),
        (["--frequencies", "61:301:120"], "frequencies must be 3"),
        (["--sensor-mass", "1"], "sensor 1 g, .* got level 0.3, sensor 5 g"),
        (["sensors.csv"], "places"),
        (["rig.yaml"], "sensor 5 g, rig .* got level 0.3"),
    ):
        if more[0] in changes:
            file = Path(more.pop())
            old, new = changes[file.name]
            assert old in file.read_text("utf-8")
            file.write_text(file.read_text("utf-8").replace(old, new), "utf-8")
        assert bench.measure("--resume", *more) == 2
        assert re.search(cause, bench.said)


def test_place_that_cannot_be_written_is_not_counted(make: Make) -> None:
    """On a full disk one error says what is in the file, which keeps the first place only."""
    bench = make(output="measured.csv")
    bench.measure(keys=[""])
    before = Path(bench.output).read_bytes()
    with full_disk(at=16):
        assert bench.measure("--resume", keys=["", ""]) == 2
    last = bench.said.splitlines()[-1]
    assert "measured.csv: cannot be written: File too large; 1 of 3 places are measured" in last
    assert Path(bench.output).read_bytes() == before


def test_place_is_repeated_or_skipped(make: Make) -> None:
    """r measures the last one again, s leaves one out, other keys and an early r do nothing."""
    bench = make()
    told = bench.measured(keys=["r", "x", "", "r", "", "s", ""])
    assert told == {"measured": ["P1", "P3"], "missing": ["P2"]}
    assert bench.card.runs == 15


def test_sensor_that_was_not_moved_is_seen(make: Make) -> None:
    """Its response is that of the place before; asked again, it is moved."""
    bench = make()
    bench.stays = ["P2"]
    assert bench.measured(keys=["", "", "", ""])["measured"] == ["P1", "P2", "P3"]
    assert bench.said.count("not kept") == 1
    assert "the sensor is still there; move it to P2" in bench.said


@pytest.mark.parametrize(
    ("muted", "said"),
    [(5, "P2 is not kept: output 1 is not heard here"), (0, "P1 is not kept: output 1 moves not")],
)
def test_output_that_was_heard_elsewhere_is_not_called_dead(
    make: Make, muted: int, said: str
) -> None:
    """Silent from the second place on, it may be on a nodal line, which s skips; else dead."""
    bench = make()
    bench.card.muted = muted
    assert bench.measured(keys=["", ""] if muted else [""])["measured"] == ["P1"] * bool(muted)
    assert said in bench.said
    assert ("; s skips it" in bench.said) == bool(muted)


@pytest.mark.parametrize(
    ("wires", "level", "cause"),
    [
        ({"on_inputs": [1, 0]}, "0.3", "silent|swapped|loop-back"),
        ({"gain": 50.0}, "0.3", "clipping"),
        ({"gain": 0.0}, "0.3", "all inputs are silent"),
        ({"noise": 0.01}, "0.001", "higher --level"),
        ({"noise": 0.3}, "0.03", "fix these sensors"),
    ],
)
def test_place_that_fails_a_check_is_told_and_asked_for_again(
    make: Make, wires: dict[str, object], level: str, cause: str
) -> None:
    """Swapped inputs, clipped, no supply: one line, nothing kept, no file.

    As much noise as signal, of 0.3 % of full scale and of far more: louder, or fixed better.
    """
    bench = make(**wires)
    assert bench.measured("--level", level, keys=["", "q"])["measured"] == []
    assert bench.said.count("P1 is not kept") == 1
    assert bench.said.count("Put the sensor at P1") == 2
    assert re.search(cause, bench.said)
    assert not Path(bench.output).exists()


def test_sensors_are_read_with_their_units(rig: Rig, tmp_path: Path) -> None:
    """A charge of 5 pC/(m/s²), amplified by 2 mV/pC, at 4 V full scale: 2.5e-3 a m/s².

    One that is moved has one input in all lines, and its mass from the file or the option.
    """
    path = tmp_path / "sensors.csv"
    path.write_text("sensor,x_m,y_m,input,mv_per_m_s2,gain,full_scale_v\nP1,0.1,0.2,3,5,2,4\n")
    (sensor,) = read_sensors(path, rig.plate)
    assert (sensor.name, sensor.x, sensor.y, sensor.input) == ("P1", 0.1, 0.2, 3)
    assert sensor.sensitivity == pytest.approx(2.5e-3)
    path.write_text(HEAD + "P1,0.1,0.1,2,10,2.5\nP2,0.2,0.1,2,10,2.5\n")
    places = read_sensors(path, rig.plate, may_move=True)
    assert [place.mass for place in places] == [2.5e-3, 2.5e-3]
    assert read_sensors(path, rig.plate, may_move=True, mass=1.0)[1].mass == 1e-3
