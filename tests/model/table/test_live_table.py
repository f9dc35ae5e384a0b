"""A table that follows a rig's parameters, against one that is built for them."""

from dataclasses import replace

import numpy as np
import pytest

from model.errors import InputError
from model.rig.file import example_rig_path, load_rig
from model.rig.rig import Rig
from model.structure.attachments import PointLoad
from model.table.build import build_table
from model.table.live_table import table_following
from model.table.question import Question
from model.table.table import LocalizationTable

FREQUENCIES = np.array([80.0, 145.0, 220.0, 310.0, 450.0])
POINTS = np.array([[0.06, 0.05], [0.15, 0.11], [0.26, 0.17], [0.22, 0.04]])


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The paper's plate."""
    return load_rig(example_rig_path())


@pytest.fixture(scope="module")
def table(rig: Rig) -> LocalizationTable:
    """Its table at a few frequencies."""
    return build_table(rig, frequencies=FREQUENCIES, drive_mode="phased")


def changed(rig: Rig) -> Rig:
    """The rig after it was identified and gained a sticker."""
    material = replace(rig.plate.material, E=0.99 * rig.plate.material.E)
    plate = replace(
        rig.plate,
        thickness=1.01 * rig.plate.thickness,
        material=material,
        loss_factor=0.013,
        loss_exponent=0.2,
        mode_deviations=((0.01, 0.2), (-0.01, 0.0)),
    )
    eras = tuple(
        replace(era, x=era.x + dx, stiffness=factor * era.stiffness, bolt_mass=0.3e-3)
        for era, dx, factor in zip(
            rig.eras, (1e-3, 0.0, -2e-3, 0.0), (1.1, 0.8, 1.0, 0.95), strict=True
        )
    )
    return replace(rig, plate=plate, eras=eras, masses=(PointLoad(0.1, 0.09, mass=3e-3),))


def test_fields_are_those_of_a_table_built_anew(rig: Rig, table: LocalizationTable) -> None:
    """Fields of the following table differ by 3 % at most where the change itself is over 20 %."""
    after = changed(rig)
    built = build_table(after, frequencies=FREQUENCIES).unit_fields(POINTS)
    followed = table_following(table, after).unit_fields(POINTS)
    size = np.linalg.norm(built, axis=(1, 2))
    error = np.linalg.norm(followed - built, axis=(1, 2)) / size
    moved = np.linalg.norm(table.unit_fields(POINTS) - built, axis=(1, 2)) / size
    assert error.max() < 0.03
    assert moved.max() > 0.2


def test_same_rig_leaves_the_table_as_it_is(rig: Rig, table: LocalizationTable) -> None:
    """A table that follows its own rig answers with the same pattern."""
    question = Question(((0.08, 0.06),), ((0.2, 0.15),), level_db_sl=0.0)
    same = table_following(table, rig)
    assert same.query(question).excitation == table.query(question).excitation
    assert same.fingerprint == table.fingerprint


def test_other_plates_are_refused(rig: Rig, table: LocalizationTable) -> None:
    """Other ERAs, sides, or a thickness 20 % larger need a build."""
    plates = (
        replace(rig.plate, length=0.31),
        replace(rig.plate, thickness=1.2 * rig.plate.thickness),
    )
    for other in (replace(rig, eras=rig.eras[:3]), *(replace(rig, plate=each) for each in plates)):
        with pytest.raises(InputError):
            table_following(table, other)
