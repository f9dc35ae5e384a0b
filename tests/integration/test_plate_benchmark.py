"""The benchmark of the plate: peers that are missing, ERAs on a receptance, choice of settings."""

import sys

import numpy as np
import pytest

from benchmarks.plate.measure import Measured
from benchmarks.plate.problem import DAMPING, PAPER, STIFFNESS, STROKE, accelerations
from benchmarks.plate.programs import Setting, installed_peers, settings
from benchmarks.plate.report import best


def test_a_peer_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing fails; a sentence on each names the package."""
    for package, module in (("ngsolve", "ngsolve_plate"), ("skfem", "scikit_fem_plate")):
        monkeypatch.setitem(sys.modules, package, None)
        monkeypatch.delitem(sys.modules, f"benchmarks.plate.peers.{module}", raising=False)
    found, missing = installed_peers()
    assert found == []
    assert [sentence.split()[0] for sentence in missing] == ["ngsolve", "skfem"]


def test_a_rigid_mass_on_one_era_is_an_oscillator() -> None:
    """x = (k + i omega c) s / (k + i omega c - m omega²), by hand."""
    omega, mass = PAPER.omega, 0.28
    receptance = (-1 / (mass * omega**2))[:, None, None].astype(complex)
    spring = STIFFNESS + 1j * omega * DAMPING
    expected = -(omega**2) * spring * STROKE / (spring - mass * omega**2)
    found = accelerations(PAPER, receptance, receptance)
    np.testing.assert_allclose(found[:, 0, 0], expected, rtol=1e-12)


def test_the_quickest_setting_that_reaches_an_error_is_shown() -> None:
    """A quicker one that is less accurate, and an accurate one that is slower, are not."""
    setting: Setting = settings(PAPER, [])[0]
    found = [
        Measured(setting, error, error, [seconds], [seconds])
        for error, seconds in ((0.02, 1.0), (0.009, 2.0), (0.004, 3.0))
    ]
    chosen = best(found, 1.0, lambda m: m.corners, lambda m: m.nothing)
    assert chosen is found[1]
    assert best(found, 0.1, lambda m: m.corners, lambda m: m.nothing) is None
