"""What a rig's table promises at the sensors of a measurement, and what of it the plate keeps.

Whatever is off, contrast tells whether it matters: the answers of the rig's table are put together
from the measured responses of the channels, and compared with what nine of ten plates would give.
"""

from dataclasses import replace

import numpy as np

from model.calibration.responses import Responses
from model.diagnosis.verdict import Verdict
from model.errors import InputError
from model.rig.rig import Rig
from model.study.promise_at_sensors import MeasuredVerification, measured_promise, promises
from model.table.build import build_table
from model.vibration.excitation import base_amplitudes

_ANSWERS = 30  # ten each with one, two and three quiet places


def judged_by_promises(verdict: Verdict, rig: Rig, observation: Responses) -> Verdict:
    """The verdict with what the plate keeps of the table's promises.

    As it is where nothing is promised or compared: without phases between channels, with one that
    was not driven, for sensors that are no fingers' breadth apart, or ERAs that make no table.
    """
    observation = observation.without(~np.isin(observation.sensors, verdict.sensors))
    rows = np.isfinite(observation.values).all(axis=(1, 2))
    if not observation.has_phases or not rows.any():
        return verdict
    names, values = [*observation.sensors], observation.values[rows]
    places = {name: (x, y) for name, (x, y) in zip(names, observation.points.tolist(), strict=True)}
    found = []
    try:
        table = build_table(rig, frequencies=observation.frequencies[rows], drive_mode="phased")
        for promise in promises(table, places, count=_ANSWERS, level=1.0, seed=0):
            frequencies, bases = base_amplitudes(promise.layer.excitation, table.eras)
            at = [names.index(each) for each in promise.sensors]
            heard = np.einsum("fe,fes->fs", bases, values[table.rows_of(frequencies)][:, :, at])
            found.append(measured_promise(table, promise, frequencies, np.abs(heard)))
    except InputError:
        return verdict
    return replace(verdict, promises=MeasuredVerification(tuple(found)))
