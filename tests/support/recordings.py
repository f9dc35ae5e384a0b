"""Files of recordings, read as users read them: by NumPy, SciPy and pyuff."""

import csv
import json
from pathlib import Path

import numpy as np
import pyuff
from scipy.io import wavfile

from sim.sensors import Recording


def read_recording(path: Path) -> Recording:
    """What a file holds, by the page on simulated hardware."""
    if path.suffix == ".csv":
        with path.open(encoding="utf-8", newline="") as stream:
            (first, *names), (x, *xs), (y, *ys), *rows = csv.reader(stream)
        assert (first, x, y) == ("time_s", "x_m", "y_m")
        assert all(name.endswith("_m_s2") for name in names)
        table = np.array(rows, dtype=float)
        times, points = table[:, 0], np.array([xs, ys], dtype=float).T
        rate = float(f"{(len(times) - 1) / (times[-1] - times[0]):.9g}")
        short = tuple(name.removesuffix("_m_s2") for name in names)
        return Recording(short, points, rate, times[0], table[:, 1:])
    if path.suffix == ".wav":
        side = json.loads(path.with_name(path.name + ".json").read_text("utf-8"))
        rate, samples = wavfile.read(path)
        assert rate == side["sample_rate_hz"]
        points = np.array([side["x_m"], side["y_m"]]).T
        scaled = side["full_scale_m_s2"] * samples.reshape(len(samples), -1).astype(float)
        return Recording(tuple(side["sensors"]), points, float(rate), side["start_s"], scaled)
    sets = pyuff.UFF(str(path)).read_sets()
    (nodes,) = [each for each in sets if each["type"] in (15, 2411)]
    signals = [each for each in sets if each["type"] == 58]
    assert all((each["func_type"], each["ordinate_spec_data_type"]) == (1, 12) for each in signals)
    x = signals[0]["x"]
    return Recording(
        tuple(each["rsp_ent_name"].strip() for each in signals),
        np.array([nodes["x"], nodes["y"]]).T,
        float(f"{(len(x) - 1) / (x[-1] - x[0]):.6g}"),
        float(x[0]),
        np.column_stack([each["data"] for each in signals]),
    )
