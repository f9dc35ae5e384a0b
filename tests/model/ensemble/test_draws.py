"""Drawn plates: what all channels have in common."""

import numpy as np
import pytest

from model.ensemble.draws import draw


def test_common_gain_moves_all_channels_together():
    """Channels that are known relative to each other are louder or softer by the same.

    By two standard deviations of 3 % on half of the plates each, however these are drawn else: of
    plates that are up to 1.28 of them off, nine of ten, each keeps nine of ten of its levels.
    """
    known = {"masses": 0, "count": 200, "seed": 8, "phase": 0.0, "harmonic": 0.0, "thicknesses": 40}
    drawn = draw(4, 2, gain=0.0, common_gain=0.03, **known)
    factors = 1 + drawn.gains[:4]
    np.testing.assert_allclose(factors, np.broadcast_to(factors[0], factors.shape), rtol=1e-6)
    sizes, counts = np.unique(np.log(factors[0].real).round(5), return_counts=True)
    assert sizes == pytest.approx([-0.06, 0.06], rel=1e-3)
    assert counts.tolist() == [100, 100]
    np.testing.assert_allclose(factors.imag, 0, atol=1e-6)
