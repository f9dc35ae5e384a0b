"""From a touch over its envelopes on a serial line to what fingertips feel while it starts."""

import asyncio

import numpy as np
import pytest

from controller.demo.run import run_demo
from controller.demo.scene import Scene
from controller.sources import contacts
from controller.sources.capture import RecordedDatagram
from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import tuio_datagram
from model.rig.file import example_rig_path, load_rig
from model.table.build import build_table
from model.table.question import Question
from model.table.timing import Timing

FRAME = 1 / 50
FINGERS = ((1, 0.30, 0.35), (2, 0.80, 0.70))  # id, x, y in TUIO's coordinates
DOWN, UP, END = 0.1, 1.2, 1.3  # s; a tenth of a second of it is measured


@pytest.fixture
def touches():
    """Two fingers that come down at one moment on a plate at rest."""
    datagrams = []
    for number in range(int(END / FRAME)):
        now = number * FRAME
        down = tuple(Touch(*finger) for finger in FINGERS) if DOWN <= now < UP else ()
        datagrams.append(
            RecordedDatagram(now, tuio_datagram(TouchFrame("test", now, down), number + 1))
        )
    return datagrams


@pytest.mark.real_time
def test_onset_contrast_matches_prediction(touches, monkeypatch):
    """Within 2 dB over the first 100 ms, and far above what the amplifier's own ramp would give."""
    monkeypatch.setattr(contacts, "CONTACT_TIMEOUT", 60.0)
    rig_file = example_rig_path()
    rig = load_rig(rig_file)
    table = build_table(rig, frequencies=np.arange(80.0, 241.0, 20.0))
    rows = asyncio.run(
        run_demo(
            rig_file,
            table,
            wire="serial",
            scenes=[Scene(touches)],
            on_row=lambda row: None,
            seed=None,
        )
    )
    (row,) = [row for row in rows if row.reason is None]
    assert row.shaped_onset
    measured = row.measured_transient_contrast_db
    assert measured == pytest.approx(row.predicted_transient_contrast_db, abs=2)
    question = Question((row.targets_m[0],), tuple(row.quiet.values()), drive_mode="phased")
    ramped = Timing(table).with_transient_measures(question, table.query(question))
    assert measured > ramped.transient_contrast_db + 6
