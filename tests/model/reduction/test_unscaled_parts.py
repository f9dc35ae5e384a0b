"""A plate with a part that stays as its thickness changes: a mass along its edges, as a double."""

from dataclasses import dataclass, fields, replace

import numpy as np
import pytest
from scipy import sparse

from model.arrays import FloatArray
from model.calibration.fit import sensed_plate
from model.errors import InputError
from model.fem import Mesh, PlateMatrices, assemble
from model.finger import Grid
from model.identification.forward import ForwardModel, Sensor
from model.identification.parameters import space_of
from model.reduction import free_plate
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.rig.rig import Rig, Uncertainty
from model.structure.attachments import PointLoad
from model.structure.plate import Plate
from model.table.table_file import TableProblem, build_table, table_following
from plates import make_paper_rig

FRAME = 0.053  # kg
FREQUENCIES = np.arange(60.0, 301.0, 20.0)
POINTS = np.array([[0.08, 0.06], [0.2, 0.15]])


@dataclass(frozen=True)
class Framed(Plate):
    """A plate with a mass [kg] along its edges, on the nodes of a mesh there."""

    frame_mass: float = 0.0


def assemble_framed(plate: Plate, mesh: Mesh) -> PlateMatrices:
    """The plate's matrices, with its frame."""
    found = assemble(plate, mesh)
    if not isinstance(plate, Framed):
        return found
    at_edge = np.isclose(mesh.nodes, 0) | np.isclose(mesh.nodes, [plate.length, plate.width])
    nodes = np.flatnonzero(at_edge.any(axis=1))
    frame = np.zeros(mesh.dof)
    frame[3 * nodes] = plate.frame_mass / len(nodes)
    return replace(found, mass=sparse.csc_array(found.mass + sparse.diags_array(frame)))


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Rig:
    """The paper's rig with a frame, in finite elements."""
    monkeypatch.setattr(free_plate, "assemble", assemble_framed)
    plain = make_paper_rig(24, 18)
    own = {each.name: getattr(plain.plate, each.name) for each in fields(plain.plate)}
    return replace(plain, plate=Framed(**own, frame_mass=FRAME))


def receptance(free: FreePlate, rig: Rig, thickness: float = 1.0) -> FloatArray:
    """Sizes of the response at POINTS to forces at the ERAs, on their springs."""
    places = np.array([(era.x, era.y) for era in rig.eras])
    loads = [PointLoad(era.x, era.y, stiffness=era.stiffness) for era in rig.eras]
    _, found = free.receptances(places, POINTS, FREQUENCIES, loads=loads, thickness=thickness)
    return np.abs(found)


@pytest.mark.parametrize(("frame", "least", "most"), [(FRAME, 0.03, 0.5), (0.0, 0.0, 0.01)])
def test_scaling_is_wrong_with_a_frame_alone(
    rig: Rig, frame: float, least: float, most: float
) -> None:
    """Against the plate solved anew 2 % thicker: the law that is refused is off by per cents."""
    plate = replace(rig.plate, frame_mass=frame)
    solved = solve_free_plate(plate, rig.mesh)
    rigid_mode = solved.modes.shapes_at(POINTS)[:, 0]
    assert rigid_mode == pytest.approx((plate.mass + frame) ** -0.5)
    exact = receptance(solve_free_plate(plate.scaled(thickness=1.02), rig.mesh), rig)
    scaled = receptance(replace(solved, plate=make_paper_rig(24, 18).plate), rig, 1.02)
    error = np.linalg.norm(scaled - exact) / np.linalg.norm(exact)
    assert least <= error <= most
    if frame:
        with pytest.raises(InputError, match=r"plate\.frame_mass"):
            receptance(solved, rig, 1.02)
    np.testing.assert_allclose(receptance(solved, rig), receptance(solved, rig, 1.0))


def test_all_that_counts_on_scaling_refuses_a_frame(rig: Rig) -> None:
    """Tables of an uncertain thickness, those that follow another, identification, calibration."""
    with pytest.raises(InputError, match=r"plate\.frame_mass.*set uncertainty"):
        TableProblem(rig, FREQUENCIES, Grid(2, 2))
    known = replace(rig, uncertainty=Uncertainty.none())
    table = build_table(known, frequencies=FREQUENCIES[:2])
    assert table_following(table, known).plate == known.plate
    with pytest.raises(InputError, match=r"plate\.frame_mass.*set uncertainty"):
        _ = replace(table, uncertainty=rig.uncertainty).attached
    for other in (
        rig.plate.scaled(thickness=1.001),
        rig.plate.scaled(modulus=1.001),
        replace(rig.plate, frame_mass=2 * FRAME),
    ):
        with pytest.raises(InputError, match=r"plate\.frame_mass.*build"):
            table_following(table, replace(known, plate=other))
    free = solve_free_plate(rig.plate, rig.mesh)
    sensors = [Sensor("SW", era="SW")]
    space = space_of(rig, ["SW"], rig.uncertainty)
    with pytest.raises(InputError, match=r"plate\.frame_mass.*era rig identify"):
        ForwardModel(rig, sensors, FREQUENCIES, space, free)
    with pytest.raises(InputError, match=r"plate\.frame_mass.*era rig identify"):
        sensed_plate(known, POINTS, FREQUENCIES)
    assert ForwardModel(
        known, sensors, FREQUENCIES, space_of(known, ["SW"], known.uncertainty), free
    )
