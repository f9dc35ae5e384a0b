"""Envelopes: the motion of a base between knots, and what no amplifier could play."""

import cmath
import math

import numpy as np
import pytest

from model.errors import InputError
from model.transients.base_motion import BaseEnvelope, Term, ramped_ending, ramped_onset
from model.vibration.excitation import Tone
from paper_plate import make_paper_rig


def motion(terms: tuple[Term, ...], time: float) -> float:
    """Displacement of a base [m] at a time [s]: the sum of the terms that hold then."""
    return sum(
        (
            (term.c0 + term.c1 * (time - term.start))
            * cmath.exp(1j * term.omega * (time - term.start))
        ).imag
        for term in terms
        if term.start <= time < term.end
    )


def test_envelope_terms_are_linear_between_knots():
    """Half way between knots the complex amplitude is their mean, at its carrier's phase."""
    envelope = BaseEnvelope(100.0, 0j, (2e-5 + 1e-5j, -4e-5j), step=0.005)
    terms = envelope.terms()
    for time, amplitude in [
        (0.0025, 1e-5 + 0.5e-5j),
        (0.0075, 1e-5 - 1.5e-5j),
        (0.02, -4e-5j),  # the last knot stays
    ]:
        expected = (amplitude * cmath.exp(2j * math.pi * 100.0 * time)).imag
        assert motion(terms, time) == pytest.approx(expected, abs=1e-17)
        assert envelope.amplitude(np.array([time]))[0] == pytest.approx(amplitude)


def test_ramped_onset_and_ending_are_raised_cosines():
    """Half way through a ramp, up or down, the amplitude is half, and none or all at its ends."""
    rig = make_paper_rig(2, 2)
    excitation = {"SE": Tone(50.0, 1e-4, 0.3)}
    up = ramped_onset(excitation, rig.eras, ramp=0.02)
    down = ramped_ending(excitation, rig.eras, ramp=0.02)
    assert [len(base) > 0 for base in up] == [era.name == "SE" for era in rig.eras]
    se = [era.name for era in rig.eras].index("SE")
    for time, share in [(0.0, 0.0), (0.01, 0.5), (0.03, 1.0)]:
        tone = 1e-4 * math.sin(2 * math.pi * 50.0 * time + 0.3)
        assert motion(up[se], time) == pytest.approx(share * tone, abs=1e-17)
        assert motion(down[se], time) == pytest.approx((1 - share) * tone, abs=1e-17)


@pytest.mark.parametrize(
    ("frequency", "knots", "step", "place"),
    [
        (100.0, (), 0.005, "got 0"),
        (100.0, (1e-5 + 0j,) * 33, 0.005, "got 33"),
        (100.0, (complex("nan"),), 0.005, "knots"),
        (100.0, (1e-5 + 0j,), 0.0, "above"),
        (0.0, (1e-5 + 0j,), 0.005, "above"),
    ],
)
def test_envelope_refuses_values_no_amplifier_plays(frequency, knots, step, place):
    """No knots, too many, not finite ones, no frequency and no step."""
    with pytest.raises(InputError, match=place):
        BaseEnvelope(frequency, 0j, knots, step)
