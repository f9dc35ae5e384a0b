"""Print how far plates of layers and air gaps are from independent solutions."""

from dataclasses import replace

import numpy as np

from benchmarks.direct_plate import direct_responder
from benchmarks.layers.elasticity import strip_frequencies, wave_number
from benchmarks.setting import RIG
from model.arrays import FloatArray
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.spectral.modes import Band, SpectralPlate
from model.spectral.polynomials import CLASSES
from model.structure.material import Material
from model.structure.plate import (
    AirGap,
    Laminate,
    LaminateLayer,
    Plate,
    bending,
    equivalent_plate,
    wavenumber_of,
)
from model.vibration import natural_modes

PANEL = load_rig(RIG.parent / "glass_panel.yaml")
GLASS = Material("glass", E=70e9, rho=2500.0, nu=0.2)
ADHESIVE = Material("adhesive", E=1e6, rho=1000.0, nu=0.49)
THIN = (LaminateLayer(GLASS, 0.7e-3), LaminateLayer(ADHESIVE, 0.1e-3), LaminateLayer(GLASS, 0.7e-3))
LENGTH, MODES, AT = 0.375, 6, 150.0
FREE_BEAM = np.array([4.730041, 7.853205, 10.995608, 14.137165, 17.278760, 20.420352])
BY_FREQUENCY = ((10.0, 0.5, 0.3), (100.0, 1.0, 0.4), (1000.0, 2.0, 0.5))
FREQUENCIES = np.array([40.0, 60.0, 80.0, 100.0, 150.0, 200.0, 250.0, 300.0, 400.0, 500.0])


def main() -> None:
    """Print all tables."""
    layers = _layers()
    print("free strips of 375 mm, error of modes 1 to 6 against elasticity")
    print("| layers | solved as | 1 | 2 | 3 | 4 | 5 | 6 |\n|---|---|---|---|---|---|---|---|")
    for name, each in (("glass_panel", layers), ("0.7/0.1/0.7 mm", THIN)):
        exact = strip_frequencies(each, LENGTH, MODES)
        _row(name, "layers", 100 * (_strip(each) / exact - 1))
        _row(name, f"one rigidity, {AT:g} Hz", 100 * (_one_rigidity(each) / exact - 1))
    print(f"\nwaves, largest error of the frequency: {_waves(layers):.3f} %")
    print("\nresponse by modes against each frequency solved, percent of its norm")
    names = " | ".join(f"{f:g} Hz" for f in FREQUENCIES)
    print(f"| adhesive | {names} |\n|---|{'---|' * len(FREQUENCIES)}")
    for what, core in (
        ("loss factor 0.3", replace(layers[1], loss_factor=0.3)),
        ("loss factor 1", replace(layers[1], loss_factor=1.0)),
        ("G by f^0.3, 0.3 to 0.5", replace(layers[1], by_frequency=BY_FREQUENCY)),
    ):
        errors = _errors(_plate((layers[0], core, layers[2])))
        print(f"| {what} | {' | '.join(f'{each:.1f} %' for each in errors)} |")
    print("\nthe example over air, modes on its ERAs, and response by modes as above")
    print("| gap | modes 1 to 4 | 40 to 100 Hz | 150 to 500 Hz |\n|---|---|---|---|")
    for depth, closed in (
        (None, False),
        (10e-3, False),
        (5e-3, False),
        (2e-3, False),
        (1e-3, False),
        (0.5e-3, False),
        (10e-3, True),
        (2e-3, True),
    ):
        gap = None if depth is None else AirGap(depth, closed=closed)
        rig = replace(PANEL, plate=replace(PANEL.plate, air_gap=gap))
        errors = _errors(rig.plate)
        name = "none" if gap is None else f"{1e3 * gap.depth:g} mm {'sealed' if closed else 'open'}"
        print(f"| {name} | {_modes(rig)} | {errors[:4].max():.1f} % | {errors[4:].max():.1f} % |")


def _row(*cells: object) -> None:
    values = [
        " | ".join(f"{each:+.2f} %" if each < 0 else f"{each:.2f} %" for each in cell)
        if isinstance(cell, np.ndarray)
        else str(cell)
        for cell in cells
    ]
    print(f"| {' | '.join(values)} |")


def _layers() -> tuple[LaminateLayer, ...]:
    assert PANEL.laminate is not None
    return PANEL.laminate.layers


def _plate(layers: tuple[LaminateLayer, ...], *, width: float = 0.225) -> Plate:
    return equivalent_plate(
        Laminate(layers), length=LENGTH, width=width, frequency=500.0, loss_factor=0.01
    )


def _strip(layers: tuple[LaminateLayer, ...]) -> FloatArray:
    """Natural frequencies [Hz] of a strip of infinite width."""
    solved = SpectralPlate(_plate(layers, width=1.0), (16, 0), AT)
    found = [
        solved.modes(each, shift=1e4, cut=1e10, band=Band(AT, AT)).eigenvalues
        for each in CLASSES
        if each[1] == 1
    ]
    squares = np.sort(np.concatenate(found))
    return np.asarray(np.sqrt(squares[squares > 1][:MODES]) / (2 * np.pi))


def _one_rigidity(layers: tuple[LaminateLayer, ...]) -> FloatArray:
    """Of a thin strip with the rigidity of a wave of one frequency."""
    laminate = Laminate(layers)
    speed = np.sqrt(bending(laminate, AT).rigidity / laminate.surface_density)
    return np.asarray((FREE_BEAM / LENGTH) ** 2 * speed / (2 * np.pi))


def _waves(layers: tuple[LaminateLayer, ...]) -> float:
    """Largest error [%] of the frequency of a wave of given length."""
    worst = 0.0
    for modulus in (0.1e6, 1e6, 10e6, 1e9):
        core = replace(layers[1], material=replace(layers[1].material, E=modulus))
        several = (layers[0], core, layers[2])
        for frequency in (40.0, 150.0, 500.0):
            ratio = wavenumber_of(Laminate(several), frequency).real
            worst = max(worst, 200 * abs(ratio / wave_number(several, frequency) - 1))
    return worst


def _errors(plate: Plate) -> FloatArray:
    """Difference [%] of the responses to the first two ERAs, the larger, (f,)."""
    x, y = np.meshgrid(np.linspace(0, plate.length, 13), np.linspace(0, plate.width, 9))
    points = np.column_stack([x.ravel(), y.ravel()])
    eras, loads = PANEL.eras[:2], PANEL.masses
    free = solve_free_plate(plate, PANEL.mesh, frequency_max=float(FREQUENCIES.max()))
    found = free.acceleration(eras, FREQUENCIES, points, loads=loads)
    exact = direct_responder(plate, PANEL.mesh)(eras, FREQUENCIES, points, loads=loads)
    difference = np.linalg.norm(found - exact, axis=2) / np.linalg.norm(exact, axis=2)
    return np.asarray(100 * difference.max(axis=1))


def _modes(rig: Rig) -> str:
    found = natural_modes(rig, 4, support="eras").frequencies
    return ", ".join(f"{each:.1f}" for each in found) + " Hz"


if __name__ == "__main__":
    main()
