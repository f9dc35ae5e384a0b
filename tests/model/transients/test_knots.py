"""The form of what quiet fingers feel during an ending, against the vibration itself."""

import math

import numpy as np

from model.transients.base_motion import BaseEnvelope, shaped
from model.transients.knots import ENDING_KNOTS, mean_square, solve_carrier, while_ending
from model.transients.measures import Transients
from model.vibration.excitation import Tone
from plate_in_time import make_plate_in_time


def test_while_ending_is_the_mean_square_of_the_response():
    """For knots at random, the form's value is that of the sampled vibration, mean over phases."""
    rig, plate = make_plate_in_time()
    frequency = 217.0
    carrier = solve_carrier(
        plate, frequency, residual_form=mean_square(plate, 0.1), gain_variance=0.0
    )
    point = np.array([[0.21, 0.06]])
    form = while_ending(carrier.hats, carrier.steady, plate.reduced.at(point))
    transients = Transients(plate)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        shape = (ENDING_KNOTS, 4)  # the tone, then seven knots, in strokes; the eighth is silence
        knots = 0.1 * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
        knots += (rng.standard_normal(4) + 1j) * np.linspace(1, 0, ENDING_KNOTS)[:, None]
        predicted = (knots.ravel().conj() @ form @ knots.ravel()).real
        sampled = 0.0
        for phase in (0.0, math.pi / 2):  # their squares add up to that of the complex amplitude
            turned = knots * np.exp(1j * phase)
            envelopes, tones = {}, {}
            for number, era in enumerate(rig.eras):
                start, *rest = (turned[:, number] * era.stroke).tolist()
                envelopes[era.name] = BaseEnvelope(frequency, start, (*rest, 0j))
                tones[era.name] = Tone(frequency, abs(start), float(np.angle(start)))
            felt = transients.acceleration(
                shaped(envelopes, rig.eras), point, duration=0.005 * ENDING_KNOTS, after=tones
            )
            sampled += (felt**2).mean()
        np.testing.assert_allclose(predicted, sampled, rtol=0.03)
