"""A board with exciters on the desk: in time against a direct solution, and identified."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.desk_plate.desk_plate import DeskPlate
from benchmarks.desk_plate.model_in_time import DeskModel
from benchmarks.desk_plate.sensing import Converters
from benchmarks.desk_plate.truth import as_built, draw_truth
from era_haptics.lab.measuring.moved_sensor import PlacesFile, measure_places
from era_haptics.lab.measuring.sound_card import Desk, Multisine
from model.calibration.fit import sensed_plate
from model.calibration.responses import WiredSensor, read_measured, responses_of
from model.identification.identify import identify
from model.rig.rig import Rig
from model.rig.rig_file import parse_rig
from model.spectral.direct_solution import direct_spectral_acceleration
from model.structure.attachments import PointLoad
from sound_cards import DeskCard

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
FREQUENCIES = np.array([41.0, 77.0, 150.0, 233.0, 291.0])
FEET = tuple(
    PointLoad(x, y, stiffness=2000.0, damping=2.0, foot=5e-3)
    for x in (0.01, 0.29)
    for y in (0.01, 0.22)
)
MESH = "9x8 Legendre"
RATE = 24_000.0
LINES_X, LINES_Y = (0.034, 0.112, 0.19, 0.259), (0.035, 0.114, 0.194)  # m
POINTS = np.array([[0.05, 0.05], [0.15, 0.11], [0.27, 0.2]])


@pytest.fixture(scope="module")
def board() -> Rig:
    """Acrylic on feet of foam, with four exciters."""
    return replace(parse_rig("board.yaml", BOARD), masses=FEET)


def test_exciters_in_time_are_those_of_the_direct_solution(board: Rig) -> None:
    """Coil, magnet and back EMF, solved at each frequency: within 0.5 %.

    What differs is damping, viscous here and hysteretic there, and the coil's inductance, of which
    equations in time have the first order.
    """
    truth = draw_truth(board, seed=5, mesh=MESH)
    found = DeskModel(truth, POINTS).under().response(FREQUENCIES).swapaxes(1, 2)
    exact = direct_spectral_acceleration(
        truth.rig.plate, board.mesh, truth.rig.eras, FREQUENCIES, POINTS, loads=truth.rig.masses
    )
    for number, actuator in enumerate(truth.actuators):
        exact[:, number] *= actuator.response(FREQUENCIES)[:, None]
    wrong = np.linalg.norm(found - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))
    assert wrong.max() < 0.005


def test_a_board_that_is_given_is_not_drawn(board: Rig) -> None:
    """Each exciter has the gain of its file amid the band, but for a lag that all have alike."""
    gains = {"SW": (1.2, 0.1), "SE": (0.8, -0.15), "NE": (1.0, 0.0), "NW": (0.9, 0.2)}
    eras = [replace(era, gains=((100.0, *gains[era.name]),)) for era in board.eras]
    truth = as_built(replace(board, eras=tuple(eras)), mesh=MESH)
    assert truth.rig.plate == board.plate
    assert [replace(era, gains=()) for era in eras] == [*truth.rig.eras]
    middle = np.array([np.sqrt(40.0 * 300.0)])
    found = np.array([each.response(middle)[0] for each in truth.actuators])
    wanted = np.array([size * np.exp(1j * phase) for size, phase in gains.values()])
    lag = found / wanted
    np.testing.assert_allclose(lag, lag[0], rtol=1e-12)
    assert abs(lag[0]) == pytest.approx(1)
    assert -0.3 < np.angle(lag[0]) < 0


def test_board_is_identified_by_one_sensor_of_known_mass(board: Rig, tmp_path: Path) -> None:
    """5 g at twelve places: fields between them are known to 3 %, and worse without the mass.

    Where no sensor was, and without it, up to the common gain that no measurement has: against the
    board's own closed form. Of acrylic, which has a loss factor of 0.05.
    """
    lossy = replace(board, plate=replace(board.plate, loss_factor=0.05))
    truth = draw_truth(lossy, seed=4, mesh=MESH)
    sensors = tuple(
        WiredSensor(f"P{n}", x, y, 1, 2e-3, 5e-3)
        for n, (x, y) in enumerate(((x, y) for y in LINES_Y for x in LINES_X), start=1)
    )
    plate = DeskPlate(truth, sensors, rate=RATE, converters=Converters(), seed=1)
    desk = Desk(lossy, sensors)
    sines = Multisine(np.arange(41.0, 300.0, 20.0), len(desk.eras) + 1, RATE, 0.3)
    file = PlacesFile(tmp_path / "measured.csv", desk, sines)

    def moved(text: str) -> str:
        plate.move_sensor(text.split("sensor at ")[1].split(",")[0])
        return ""

    card = DeskCard(plate, rate=RATE)
    measure_places(file, card, periods=2, ask=moved, tell=lambda text: None)
    responses = responses_of(read_measured(file.path), lossy)
    full = np.array([era.full_level for era in lossy.eras])
    exact = DeskModel(truth, POINTS).under().response(FREQUENCIES).swapaxes(1, 2) / full[:, None]
    errors = []
    for masses in (responses.masses, None):
        found = identify(lossy, replace(responses, masses=masses).as_measurement())
        gains = np.array([era.gain(FREQUENCIES) for era in found.rig.eras]).T
        field = sensed_plate(found.rig, POINTS, FREQUENCIES).responses() * gains[:, :, None]
        common = np.vdot(field, exact) / np.vdot(field, field)
        errors.append(np.linalg.norm(common * field - exact) / np.linalg.norm(exact))
    assert errors[0] < 0.03
    assert errors[1] > 1.25 * errors[0]
