"""A board on exciters as sold: sound ones pass, and each mistake of a maker is named."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.identification.mistakes import on_glue
from model.arrays import FloatArray
from model.calibration.responses import Responses
from model.diagnosis.diagnosis_report import verdict_rows
from model.diagnosis.verdict import Verdict, diagnose
from model.rig.rig import Rig
from model.spectral.direct_solution import direct_spectral_acceleration
from model.spectral.modes import SpectralMesh
from model.structure.exciter import Exciter
from plates import exciter_rig

TONES = np.arange(41.0, 300.0, 20.0)
PLACES = np.array([(0.3 * x, 0.23 * y) for x in (0.1, 0.4, 0.88) for y in (0.15, 0.5, 0.85)])
PARTS = "uncertainty: {gain: 0.2, phase_deg: 10, stiffness: 0.2, modulus: 0.1, thickness: 0.02}"


def as_sold(rig: Rig, seed: int) -> Rig:
    """A board of another rigidity (10 %) with exciters whose parts differ (20 %, 10 degrees)."""
    rng = np.random.default_rng(seed)

    def factor(deviation: float) -> float:
        return float(np.exp(deviation * rng.standard_normal()))

    eras = tuple(
        replace(
            era,
            stiffness=factor(0.2) * era.in_time.stiffness,
            magnet_mass=factor(0.2) * getattr(era, "magnet_mass"),  # noqa: B009
            force_factor=factor(0.2) * getattr(era, "force_factor"),  # noqa: B009
            gains=((100.0, factor(0.2), float(np.radians(10) * rng.standard_normal())),),
        )
        for era in rig.eras
    )
    return replace(rig, plate=rig.plate.scaled(modulus=factor(0.1)), eras=eras)


def checked(
    seed: int,
    *,
    loose: int | None = None,
    glue: float = 0.0,
    wired: FloatArray | None = None,
) -> Verdict:
    """A board checked by nine sensors with 0.5 % of noise.

    glue [N/m]: of the loose exciter; wired (e, s): signs of what is read.
    """
    rig = exciter_rig("type: DAEX25FHE-4, power: 1 W", frequency="[40, 300]", more=PARTS)
    true = as_sold(rig, seed)
    assert isinstance(rig.mesh, SpectralMesh)
    sources = [
        on_glue(era, glue) if number == loose and isinstance(era, Exciter) else era
        for number, era in enumerate(true.eras)
    ]
    values = direct_spectral_acceleration(
        true.plate, rig.mesh, sources, TONES, PLACES, loads=true.masses
    )
    values = values / np.array([era.full_level for era in rig.eras])[:, None]
    size = np.sqrt((np.abs(values) ** 2).mean(axis=2, keepdims=True))
    noise = np.random.default_rng([seed, 1]).standard_normal((2, *values.shape))
    values = values + 0.005 * size * (noise[0] + 1j * noise[1])
    signs = np.ones(values.shape[1:]) if wired is None else wired
    names = tuple(f"P{number}" for number in range(1, len(PLACES) + 1))
    return diagnose(rig, Responses(names, PLACES, TONES, signs * values))


@pytest.mark.parametrize("seed", [3, 4])
def test_sound_board_of_parts_as_sold_is_well(seed: int) -> None:
    """Gains and force factors that are 20 % off together are no weak exciter, nor another plate."""
    assert verdict_rows(checked(seed)) == ["ALL WELL: plate and channels match the rig"]


@pytest.mark.parametrize("glue", [600.0, 4000.0])
def test_exciter_whose_glue_is_off_is_loose_and_nothing_else(glue: float) -> None:
    """By its dynamic stiffness, or by how its gain rises; its size may be that of a weak one."""
    verdict = checked(5, loose=2, glue=glue)
    assert [channel.states[0] for channel in verdict.channels] == ["well", "well", "loose", "well"]
    rows = verdict_rows(verdict)
    assert rows[0].startswith("LOOSE: channel 2 of amplifier card (ERA NE in the rig)")
    assert not any(row.startswith("PLATE") for row in rows)


def test_exciter_wired_backwards_and_sensor_upside_down_are_told_apart() -> None:
    """One has the opposite sign at every sensor, the other under every exciter."""
    signs = np.ones((4, len(PLACES)))
    signs[1] *= -1
    signs[:, 4] *= -1
    verdict = checked(6, wired=signs)
    assert [channel.states for channel in verdict.channels] == [
        ("well",), ("inverted",), ("well",), ("well",)
    ]  # fmt: skip
    (sensor,) = verdict.bad_sensors
    assert sensor.name == "P5"
    assert "upside down" in sensor.why
