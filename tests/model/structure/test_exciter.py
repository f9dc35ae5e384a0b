"""Exciters by numbers worked out by hand, and on a plate by an independent solver."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.direct_plate import direct_acceleration
from model.arrays import ComplexArray, lattice
from model.fem import assemble
from model.reduction.free_plate import solve_free_plate
from model.structure.attachments import Fingertip, FingertipLoad
from model.structure.exciter import Actuator, Exciter
from model.vibration import reference_mesh
from plates import exciter_rig

# DAEX25FHE-4 of its sheet with Qms 3, R_g 0.1 ohm, 1 W.
BY_HAND = Exciter(
    "SW",
    0.1,
    0.1,
    stiffness=3189.20,
    damping=0.7553,
    magnet_mass=0.10929,
    coil_mass=1.61e-3,
    force_factor=3.63,
    resistance=4.3,
    voltage=3.0008,
    source_resistance=0.1,
    inductance=1e-4,
)


@pytest.mark.parametrize(
    ("frequency", "force", "stiffness", "held"),
    [
        (20, -2.6413 + 0.8583j, -3594.3 + 593.1j, False),
        (60, 3.0801 + 0.3263j, 3546.1 + 2213.0j, False),
        (100, 2.6675 + 0.1192j, 2677.8 + 2741.1j, False),
        (250, 2.5044 - 0.0340j, -706.5 + 6031.0j, False),
        (100, 2.4751 - 0.0353j, 2580.5 + 2355.9j, True),
    ],
)
def test_force_and_dynamic_stiffness_by_hand(
    frequency: float, force: complex, stiffness: complex, held: bool
) -> None:
    """Of a magnet that is free, and of one that a frame holds, to the digits worked out."""
    omega = 2 * np.pi * np.array([frequency])
    exciter = replace(BY_HAND, held=held)
    assert exciter.force(omega)[0] == pytest.approx(force, rel=1e-4)
    assert exciter.dynamic_stiffness(omega)[0] == pytest.approx(stiffness, rel=1e-4)


@pytest.mark.parametrize("held", [False, True])
def test_errors_of_the_suspension_act_as_its_changes_say(held: bool) -> None:
    """Of one that is stiffer or damps more, the force changes as much as the stiffness does.

    At any size, by the motion of its base; and dampers by a difference.
    """
    omega, step = 2 * np.pi * np.array([30.0, 47.0, 120.0, 400.0]), 1e-5
    exciter = replace(BY_HAND, held=held, gains=((100.0, 0.5, 0.3),))
    at_rest, force = exciter.dynamic_stiffness(omega), exciter.force(omega)
    damped = exciter.varied(damping=1 + step).dynamic_stiffness(omega)
    by_damping = exciter.damping * exciter.slopes(omega)["damping"][0]
    assert by_damping == pytest.approx((damped - at_rest) / step, rel=1e-3)
    for key in ("stiffness", "damping"):
        other = exciter.varied(**{key: 1.3})
        pushed = (other.dynamic_stiffness(omega) - at_rest) * exciter.base(omega)
        size = np.abs(force).max()
        assert pushed == pytest.approx(other.force(omega) - force, abs=1e-9 * size)
        drive = exciter.full_level * exciter.gain(omega / (2 * np.pi))
        off = {"stiffness": 1.0, "damping": 1.0, key: 1.3}
        stiffness, by_voltage = exciter.deviating(omega, **off)
        assert stiffness == pytest.approx(exciter.varied(**off).dynamic_stiffness(omega))
        assert by_voltage * drive == pytest.approx(exciter.varied(**off).force(omega))


@pytest.mark.parametrize("magnet", ["free", "held"])
def test_response_on_a_board_against_magnet_and_current_solved_beside_it(magnet: str) -> None:
    """Finite elements with the magnets' and the coils' own equations: within 0.3 % of the field.

    Of four exciters on acrylic on foam, under a finger, from 40 to 500 Hz.
    """
    keys = f"type: DAEX25FHE-4, magnet: {magnet}"
    rig = exciter_rig(keys, frequency="[40, 500]", more="mesh: auto 0.1 %")
    finger = FingertipLoad(0.11, 0.09, Fingertip())
    frequencies = np.array([40.0, 70.0, 107.0, 160.0, 240.0, 330.0, 420.0, 500.0])
    points = lattice(np.linspace(0, 0.3, 13), np.linspace(0, 0.23, 10))
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    loads = (*rig.masses, finger)
    found = free.acceleration(rig.eras, frequencies, points, loads=loads)
    mesh = reference_mesh(rig.plate, frequency_max=500.0)
    expected = direct_acceleration(
        assemble(rig.plate, mesh), rig.eras, frequencies, points, loads=loads
    )
    apart = np.linalg.norm(found - expected, axis=2) / np.linalg.norm(expected, axis=2)
    assert apart.max() < 3e-3


def test_damping_of_suspension_and_current_act_alike() -> None:
    """What one damps 40 % more the current damps less, at as much force: fields within 0.2 %.

    From 40 to 300 Hz, on four coin exciters with 0.6 of c + Bl² / R in the suspension; the
    suspension's alone changes them by 10 % and more.
    """
    rig = exciter_rig("type: DAEX25CT-4", frequency="[40, 300]")
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=300.0)
    points = lattice(np.linspace(0, 0.3, 7), np.linspace(0, 0.23, 5))
    swapped, damped = [], []
    for each in rig.eras:
        assert isinstance(each, Exciter)
        moved = 0.4 * each.damping
        weaker = np.sqrt(each.force_factor**2 - each.loop_resistance * moved)
        louder = ((100.0, each.force_factor / weaker, 0.0),)
        damped.append(replace(each, damping=each.damping + moved))
        swapped.append(replace(damped[-1], force_factor=float(weaker), gains=louder))

    def fields(eras: Sequence[Actuator]) -> ComplexArray:
        return free.acceleration(eras, np.arange(40.0, 301.0, 10.0), points, loads=rig.masses)

    as_is, alike, other = (fields(each) for each in (rig.eras, swapped, damped))
    size = np.linalg.norm(as_is, axis=(1, 2))
    apart, alone = (np.linalg.norm(each - as_is, axis=(1, 2)) / size for each in (alike, other))
    assert apart.max() < 2e-3
    assert alone.max() > 0.1
