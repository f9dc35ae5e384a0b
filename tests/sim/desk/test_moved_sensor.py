"""A plate measured with one sensor that is moved: its mass, its file, and what can go wrong."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.desk_plate.desk_plate import DeskPlate
from benchmarks.desk_plate.model_in_time import DeskModel
from benchmarks.desk_plate.sensing import Converters
from benchmarks.desk_plate.truth import Truth
from desk_card import DeskCard
from model.arrays import Float32Array, FloatArray
from model.calibration.responses import responses_of
from model.calibration.responses_file import read_measured
from model.calibration.sensor_file import WiredSensor, read_sensors
from model.errors import InputError
from model.identification.identify import identify
from model.rig.rig import Rig
from sim.desk.measuring.desk import Desk
from sim.desk.measuring.moved_sensor import PlacesFile, measure_places
from sim.desk.measuring.multisine import Multisine
from sim.desk.measuring.sound_card import DeviceLost

RATE, LEVEL, GRAMS = 8_000.0, 0.3, 5.0
PLACES = {"P1": (0.03, 0.05), "P2": (0.20, 0.11), "P3": (0.29, 0.20)}
SENSORS = tuple(WiredSensor(name, x, y, 1, 2e-3, GRAMS / 1e3) for name, (x, y) in PLACES.items())
FREQUENCIES = np.array([61.0, 151.0, 233.0, 311.0])
LINES = np.arange(51.0, 500.0, 60.0)
SPREAD = (0.035, 0.114, 0.194, 0.264)  # m


@dataclass
class Person:
    """Moves the sensor as the terminal says, or by replies of its own; hears what it says.

    replies: for the prompts in turn, then Enter for all; stays: places to which it does not move.
    """

    plate: DeskPlate
    replies: list[str] = field(default_factory=list)
    stays: list[str] = field(default_factory=list)
    prompts: list[str] = field(default_factory=list)
    said: list[str] = field(default_factory=list)

    def ask(self, text: str) -> str:
        """Move the sensor, and press a key."""
        self.prompts.append(text)
        name = text.split("sensor at ")[1].split(",")[0]
        reply = self.replies.pop(0) if self.replies else ""
        if reply == "Ctrl-C":
            raise KeyboardInterrupt
        if self.stays[:1] == [name]:
            self.stays.pop(0)
        else:
            self.plate.move_sensor(name)
        return f"{reply}\n"


class Bench:
    """A rig's plate behind a card in memory, one sensor, and the file."""

    def __init__(
        self,
        rig: Rig,
        truth: Truth,
        path: Path,
        *,
        sensors: Sequence[WiredSensor] = SENSORS,
        noise: float = 5e-3,
        **wires: object,
    ) -> None:
        converters = Converters(delay=73, noise=noise)
        plate = DeskPlate(truth, sensors, rate=RATE, converters=converters, seed=1)
        self.card = PulledCard(plate, rate=RATE, **wires)  # type: ignore[arg-type]
        self.person = Person(plate)
        self.desk = Desk(rig, tuple(sensors))
        lines = LINES if len(sensors) > len(SENSORS) else FREQUENCIES
        self.sines = Multisine(lines, len(self.desk.eras) + 1, RATE, LEVEL)
        self.path = path
        self.file = PlacesFile(path, self.desk, self.sines)

    def measure(self) -> list[str]:
        """Measure what is missing; returns the places that were measured."""
        return [
            *measure_places(
                self.file,
                self.card,
                periods=2,
                ask=self.person.ask,
                tell=self.person.said.append,
            )
        ]


class PulledCard(DeskCard):
    """Its plug is pulled in the run of that number, if any; muted: output 1 is, from that run."""

    pulled: int | None = None
    muted: int | None = None

    def run(self, played: FloatArray) -> Float32Array:
        """Advance the plate, or be gone."""
        if self.runs == self.pulled:
            raise DeviceLost("memory: the device was lost, or takes no samples")
        if self.muted is not None and self.runs >= self.muted:
            played = played * (np.arange(played.shape[1]) != 0)
        return super().run(played)


@pytest.fixture
def bench(rig: Rig, truth: Truth, tmp_path: Path) -> Bench:
    """All as it should be."""
    return Bench(rig, truth, tmp_path / "measured.uff")


def test_each_place_is_measured_under_the_sensors_mass(
    rig: Rig, truth: Truth, bench: Bench
) -> None:
    """Against the plate's closed form with the mass at that place alone; the file has all of it.

    5 g change responses by several percent, so that the bare plate can be distinguished from it.
    """
    assert bench.measure() == ["P1", "P2", "P3"]
    assert "x 30 mm, y 50 mm (place 1 of 3)" in bench.person.prompts[0]
    found = responses_of(read_measured(bench.path), rig)
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
def test_measurement_that_was_stopped_goes_on(bench: Bench, ending: str) -> None:
    """Stopped by q, by Ctrl-C and by a pulled card: the rest is measured, and no place twice."""
    bench.path = bench.path.with_suffix(f".{ending}")
    bench.file = PlacesFile(bench.path, bench.desk, bench.sines)
    bench.person.replies = ["", "q"]
    assert bench.measure() == ["P1"]
    bench.person.replies = ["", "Ctrl-C"]
    bench.file = PlacesFile(bench.path, bench.desk, bench.sines)
    bench.file.read()
    with pytest.raises(KeyboardInterrupt):
        bench.measure()
    before = bench.path.read_bytes()
    bench.card.pulled = bench.card.runs + 2
    with pytest.raises(DeviceLost):
        bench.measure()
    assert bench.path.read_bytes() == before
    bench.card.pulled = None
    bench.file = PlacesFile(bench.path, bench.desk, bench.sines)
    bench.file.read()
    assert [place.name for place in bench.file.missing] == ["P3"]
    assert bench.measure() == ["P3"]
    assert {each.sensor for each in read_measured(bench.path)} == set(PLACES)


def test_files_of_another_measurement_are_not_gone_on_with(rig: Rig, bench: Bench) -> None:
    """Another level, rig, frequency, mass and place, each by its name."""
    bench.person.replies = ["", "q"]
    bench.measure()
    eras = (replace(rig.eras[0], stiffness=2e4), *rig.eras[1:])
    heavy = tuple(replace(place, mass=1e-3) for place in SENSORS)
    aside = (replace(SENSORS[0], x=0.04), *SENSORS[1:])
    for desk, sines, cause in (
        (bench.desk, replace(bench.sines, level=0.2), "setting must be level 0.2"),
        (Desk(replace(rig, eras=eras), SENSORS), bench.sines, "sensor 5 g, rig .* got level 0.3"),
        (bench.desk, replace(bench.sines, frequencies=FREQUENCIES[:3]), "frequencies"),
        (Desk(rig, heavy), bench.sines, "sensor 1 g, .* got level 0.3, sensor 5 g"),
        (Desk(rig, aside), bench.sines, "places"),
    ):
        with pytest.raises(InputError, match=cause):
            PlacesFile(bench.path, desk, sines).read()


def test_place_is_repeated_or_skipped(bench: Bench) -> None:
    """r measures the last one again, s leaves one out, other keys and an early r do nothing."""
    bench.person.replies = ["r", "x", "", "r", "", "s", ""]
    assert bench.measure() == ["P1", "P3"]
    assert bench.card.runs == 15
    assert [place.name for place in bench.file.missing] == ["P2"]


def test_sensor_that_was_not_moved_is_seen(bench: Bench) -> None:
    """Its response is that of the place before; asked again, it is moved."""
    bench.person.stays = ["P2"]
    assert bench.measure() == ["P1", "P2", "P3"]
    (refusal,) = [text for text in bench.person.said if "not kept" in text]
    assert "the sensor is still there; move it to P2" in refusal


@pytest.mark.parametrize(
    ("muted", "said"),
    [(5, "P2 is not kept: output 1 is not heard here"), (0, "P1 is not kept: output 1 moves not")],
)
def test_output_that_was_heard_elsewhere_is_not_called_dead(
    bench: Bench, muted: int, said: str
) -> None:
    """Silent from the second place on, it may be on a nodal line, which s skips; else dead."""
    bench.card.muted = muted
    bench.person.replies = ["", "", "q"] if muted else ["", "q"]
    assert bench.measure() == ["P1"] * bool(muted)
    assert bench.person.said[-1].startswith(said)
    assert ("s skips it" in bench.person.said[-1]) == bool(muted)


@pytest.mark.parametrize(
    ("wires", "cause"),
    [
        ({"on_inputs": [1, 0]}, "silent|swapped|loop-back"),
        ({"gain": 50.0}, "clipping"),
        ({"gain": 0.0}, "all inputs are silent"),
    ],
)
def test_place_that_fails_a_check_is_told_and_asked_for_again(
    rig: Rig, truth: Truth, tmp_path: Path, wires: dict[str, object], cause: str
) -> None:
    """Swapped inputs, clipped, no supply: one line, nothing kept, no file."""
    bench = Bench(rig, truth, tmp_path / "measured.uff", **wires)
    bench.person.replies = ["", "q"]
    assert bench.measure() == []
    _, said = bench.person.said
    assert said.startswith("P1 is not kept")
    assert len(bench.person.prompts) == 2
    assert re.search(cause, said)
    assert not bench.path.exists()


@pytest.mark.parametrize(
    ("level", "noise", "remedy"),
    [(0.001, 0.01, "higher --level"), (0.03, 0.3, "fix these sensors")],
)
def test_faint_sensor_is_told_from_a_loose_one(
    rig: Rig, truth: Truth, tmp_path: Path, level: float, noise: float, remedy: str
) -> None:
    """As much noise as signal, of 0.3 % of full scale and of far more: louder, or fixed better."""
    bench = Bench(rig, truth, tmp_path / "measured.uff", noise=noise)
    bench.file.multisine = replace(bench.sines, level=level)
    bench.person.replies = ["", "q"]
    bench.measure()
    assert remedy in bench.person.said[1]


TWELVE = tuple(
    WiredSensor(f"P{n}", x, y, 1, 2e-3, 2e-3)
    for n, (x, y) in enumerate(((x, y) for y in (0.035, 0.114, 0.194) for x in SPREAD), start=1)
)


def test_plate_is_identified_better_with_the_mass_of_the_sensor(
    rig: Rig, truth: Truth, tmp_path: Path
) -> None:
    """2 g at 12 places of a plate that deviates: the model explains them with the mass alone.

    Springs, per mass of the plate, are then within four of the standard deviations written.
    """
    bench = Bench(rig, truth, tmp_path / "measured.csv", sensors=TWELVE)
    bench.measure()
    found = responses_of(read_measured(bench.path), rig)
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


HEAD = "sensor,x_m,y_m,input,mv_per_m_s2,mass_g\n"


def test_sensors_file_of_one_sensor(rig: Rig, tmp_path: Path) -> None:
    """One input in all lines; its mass from the file or the option; never several masses at once.

    Nor two sensitivities of one sensor.
    """
    path = tmp_path / "sensors.csv"
    path.write_text(HEAD + "P1,0.1,0.1,2,10,2.5\nP2,0.2,0.1,2,10,2.5\n")
    places = read_sensors(path, rig.plate, may_move=True)
    assert [place.mass for place in places] == [2.5e-3, 2.5e-3]
    assert read_sensors(path, rig.plate, may_move=True, mass=1.0)[1].mass == 1e-3
    for lines, may_move, cause in (
        ("P1,0.1,0.1,2,10,2.5\nP2,0.2,0.1,2,10,2.5\n", False, ":3: input"),
        ("P1,0.1,0.1,2,10,2.5\nP2,0.2,0.1,2,11,2.5\n", True, ":3: .*sensitivity"),
        ("P1,0.1,0.1,1,10,2.5\nP2,0.2,0.1,2,10,0\n", True, "mass_g"),
        ("P1,0.1,0.1,2,10,2500\n", True, ":2: mass_g .*grams"),
    ):
        path.write_text(HEAD + lines)
        with pytest.raises(InputError, match=cause):
            read_sensors(path, rig.plate, may_move=may_move)
