"""The drawn field of several contents."""

import struct
from typing import NamedTuple

import numpy as np
import pytest

from controller.api.schema import PlayedTone
from controller.gateway.field import FieldSolver
from model.arrays import ComplexArray
from model.rig.file import example_rig_path, load_rig


def test_frame_has_a_field_of_each_content() -> None:
    """Two contents at one frequency stay apart, and each is what it is alone.

    With the threshold of feeling at 100 Hz, 0.249 m/s² in the file of the set by the probe.
    """
    solver = FieldSolver(load_rig(example_rig_path()))
    one = PlayedTone(frequency_hz=100.0, level=0.5, phase_deg=0.0)
    other = PlayedTone(frequency_hz=100.0, level=0.25, phase_deg=90.0)
    drives = {0: {"SW": one}, 3: {"SW": other, "NE": other}}
    both = decoded(solver.frame(drives))
    assert both.layers == (0, 3)
    assert both.frequencies == (100.0, 100.0)
    assert both.thresholds == pytest.approx((0.249, 0.249))
    for field, (number, drive) in zip(both.fields, drives.items(), strict=True):
        (alone,) = decoded(solver.frame({number: drive})).fields
        assert field == pytest.approx(alone, abs=1e-4 * np.abs(both.fields).max())


class Decoded(NamedTuple):
    """A frame: fields (count, points) [m/s²], and of each its frequency, threshold and layer."""

    fields: ComplexArray
    frequencies: tuple[float, ...]
    thresholds: tuple[float, ...]
    layers: tuple[int, ...]


def decoded(frame: bytes) -> Decoded:
    """Decode a frame as the page of the reference describes it."""
    columns, rows, count, _ = struct.unpack_from("<4H", frame)
    scale, *numbers = struct.unpack_from(f"<{1 + 2 * count}f", frame, 8)
    layers = struct.unpack_from(f"<{count}H", frame, 12 + 8 * count)
    parts = np.frombuffer(frame, "<i2", offset=12 + 10 * count).reshape(count, rows * columns, 2)
    fields = (parts[..., 0] + 1j * parts[..., 1]) * scale / 32767
    return Decoded(fields, tuple(numbers[:count]), tuple(numbers[count:]), layers)
