"""`era measure` with one sensor that is moved: its mass, its file, and what can go wrong."""

import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.desk_plate.desk_plate import DeskPlate
from benchmarks.desk_plate.model_in_time import DeskModel
from benchmarks.desk_plate.sensing import Converters
from benchmarks.desk_plate.truth import Truth
from controller.cli.main import run
from era_haptics.lab.measuring.sound_card import DeviceLost
from model.arrays import Float32Array, FloatArray
from model.calibration.responses import read_measured, read_sensors, responses_of
from model.errors import InputError
from model.identification.identify import identify
from model.rig.rig import Rig
from model.rig.rig_file import example_rig_path
from sound_cards import DeskCard

RATE, GRAMS = 8_000.0, 5.0
Places = Mapping[str, tuple[float, float]]
PLACES: Places = {"P1": (0.03, 0.05), "P2": (0.20, 0.11), "P3": (0.29, 0.20)}
FREQUENCIES = np.array([61.0, 141.0, 221.0, 301.0])
HEAD = "sensor,x_m,y_m,input,mv_per_m_s2,mass_g\n"
PLAIN = "sensor,x_m,y_m,input,mv_per_m_s2\n"
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
        places: Places = PLACES,
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
        self._plate = DeskPlate(truth, sensors, rate=RATE, converters=converters, seed=1)
        self.card = PulledCard(self._plate, rate=RATE, **wires)  # type: ignore[arg-type]
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
        status = run([*words, self.output, "--frequencies", "61:301:80", *more])
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
    found = responses_of(read_measured(Path(bench.output)), rig)
    model = DeskModel(truth, np.array([*PLACES.values()]))
    strokes = np.array([era.stroke for era in rig.eras])
    bare = model.under().response(FREQUENCIES).swapaxes(1, 2) / strokes[:, None]
    for n, name in enumerate(PLACES):
        one = model.under(moved=(n, GRAMS / 1e3)).response(FREQUENCIES)[:, 0] / strokes
        measured = found.values[:, :, found.sensors.index(name)]
        wrong = np.linalg.norm(measured - one) / np.linalg.norm(one)
        assert wrong < 0.02
        assert np.linalg.norm(measured - bare[:, :, n]) / np.linalg.norm(one) > 2 * wrong
    assert found.masses is not None
    np.testing.assert_allclose(found.masses, GRAMS / 1e3)


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
    told = bench.measured("--resume", keys=[""])
    assert told == {"measured": ["P3"], "missing": []}
    assert json.loads(bench.out)["sensors"]["P3"]["coherence_min"] > 0.9
    assert {each.sensor for each in read_measured(Path(bench.output))} == set(PLACES)


def test_files_of_another_measurement_are_not_gone_on_with(make: Make) -> None:
    """Another level, frequency, mass, place and rig, each by its name."""
    bench = make()
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


@pytest.mark.parametrize(
    ("more", "cause"),
    [
        (["--resume"], "to go on from"),
        (["--stepped"], "--stepped needs sensors that stay"),
        (["--sensor-mass", "900"], "mass_g must be from 0"),
    ],
)
def test_options_that_do_not_fit_are_refused(make: Make, more: list[str], cause: str) -> None:
    """Nothing to resume, single tones of a moved sensor, a mass in other units."""
    bench = make()
    assert bench.measure(*more) == 2
    assert cause in bench.said


def test_plate_is_identified_better_with_the_mass_of_the_sensor(
    rig: Rig, truth: Truth, make: Make
) -> None:
    """2 g at 12 places of a plate that deviates: the model explains them with the mass alone.

    Springs, per mass of the plate, are then within four of the standard deviations written.
    """
    grid = [(x, y) for y in (0.035, 0.114, 0.194) for x in (0.035, 0.114, 0.194, 0.264)]
    places = {f"P{n}": place for n, place in enumerate(grid, start=1)}
    bench = make(output="measured.csv", places=places, grams=2.0)
    assert bench.measure("--frequencies", "51:471:60", keys=[""] * len(places)) == 0
    found = responses_of(read_measured(Path(bench.output)), rig)
    assert found.masses is not None
    known, ignored = (
        identify(rig, replace(found, masses=masses).as_measurement())
        for masses in (found.masses, None)
    )
    assert (known.is_explained, ignored.is_explained) == (True, False)
    mass = truth.rig.plate.thickness / known.rig.plate.thickness
    for era, real in zip(known.rig.eras, truth.rig.eras, strict=True):
        std = known.rig.uncertainty.stiffness
        assert std < 0.01
        assert mass * era.stiffness == pytest.approx(real.stiffness, rel=4 * std)


def test_sensors_file_of_one_sensor(rig: Rig, tmp_path: Path) -> None:
    """One input in all lines; its mass from the file or the option."""
    path = tmp_path / "sensors.csv"
    path.write_text(HEAD + "P1,0.1,0.1,2,10,2.5\nP2,0.2,0.1,2,10,2.5\n")
    places = read_sensors(path, rig.plate, may_move=True)
    assert [place.mass for place in places] == [2.5e-3, 2.5e-3]
    assert read_sensors(path, rig.plate, may_move=True, mass=1.0)[1].mass == 1e-3


@pytest.mark.parametrize(
    ("text", "may_move", "cause"),
    [
        ("sensor,x_m,y_m,input\nP1,0,0,1\n", False, ":1:"),
        (f"{PLAIN}P1,0.1,0.1,1,10\nP2,9,0.1,2,10\n", False, ":3:"),
        (f"{PLAIN}P1,0.1,0.1,1,10\nP2,0.2,0.1,1,10\n", False, ":3: input"),
        (f"{PLAIN}P1,0.1,0.1,1,0\n", False, ":2:"),
        (f"{PLAIN}P1,0.1,x,1,10\n", False, ":2:"),
        (f"{PLAIN}P1,0.1,0.1,1,10,2\n", False, ":2:"),
        (f"{HEAD}P1,0.1,0.1,2,10,2.5\nP2,0.2,0.1,2,11,2.5\n", True, ":3: .*sensitivity"),
        (f"{HEAD}P1,0.1,0.1,1,10,2.5\nP2,0.2,0.1,2,10,0\n", True, ": mass_g"),
        (f"{HEAD}P1,0.1,0.1,1,10,2500\n", True, ":2: mass_g .*grams"),
    ],
)
def test_sensors_files_are_refused_with_their_line(
    rig: Rig, tmp_path: Path, text: str, may_move: bool, cause: str
) -> None:
    """A missing column, off the plate, an input twice, no sensitivity, no number, one too many.

    Two sensitivities of one sensor that is moved, several masses at once, a mass in other units.
    """
    path = tmp_path / "sensors.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=f"sensors.csv{cause}"):
        read_sensors(path, rig.plate, may_move=may_move)
