"""Drawn plates: what all channels have in common."""

import numpy as np
import pytest

from model.ensemble.draws import draw


def test_common_gain_moves_all_channels_together():
    """Channels that are known relative to each other are louder or softer by the same, 3 %."""
    known = {"masses": 0, "count": 200, "seed": 8, "phase": 0.0, "harmonic": 0.0, "thicknesses": 40}
    drawn = draw(4, 2, gain=0.0, common_gain=0.03, **known)
    factors = 1 + drawn.gains[0, :4]
    np.testing.assert_allclose(factors, np.broadcast_to(factors[0], factors.shape), rtol=1e-6)
    assert np.log(factors[0].real).std() == pytest.approx(0.03, rel=1e-3)
    np.testing.assert_allclose(factors.imag, 0, atol=1e-6)
