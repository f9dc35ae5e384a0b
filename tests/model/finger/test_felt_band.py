"""What skin can feel of a vibration, against tones."""

import numpy as np
import pytest

from model.finger.perception import felt_part


@pytest.mark.parametrize("rate", [8000.0, 10_000.0, 44_100.0])
@pytest.mark.parametrize(
    ("frequency", "passes"), [(40, 1), (300, 1), (850, 1), (1800, 0), (2500, 0), (3900, 0)]
)
def test_felt_part_passes_tones_up_to_a_kilohertz(
    rate: float, frequency: float, passes: float
) -> None:
    """Within 1 %, in phase and sample by sample; what is far above is gone."""
    times = np.arange(round(0.1 * rate)) / rate
    tone = np.sin(2 * np.pi * frequency * times + 0.7)
    found = felt_part(np.column_stack([tone, -2 * tone]), rate)
    inner = (times > 0.003) & (times < 0.097)
    np.testing.assert_allclose(found[inner, 0], passes * tone[inner], atol=0.01)
    np.testing.assert_allclose(found[:, 1], -2 * found[:, 0], atol=1e-12)


def test_felt_part_of_slow_samples_is_all_of_them() -> None:
    """At 2 kHz nothing above 1 kHz is in them; none at all are none."""
    samples = np.random.default_rng(0).normal(size=(50, 2))
    np.testing.assert_array_equal(felt_part(samples, 2000.0), samples)
    assert felt_part(np.zeros((0, 3)), 10_000.0).shape == (0, 3)
