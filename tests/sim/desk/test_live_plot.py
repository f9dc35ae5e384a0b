"""The plot in plain text while a plate is measured."""

import io

import numpy as np
import pytest
from rich.console import Console

from sim.measuring.live_plot import STEPS, levels, live_plot, plot
from sim.measuring.multisine import Multisine
from sim.sensors.sensor_file import WiredSensor

RATE = 2000.0
MULTISINE = Multisine(np.array([61.0, 121.0, 181.0, 241.0]), 3, RATE, 0.3)
SENSORS = tuple(WiredSensor(f"P{n}", 0.1, 0.1, n, 1.0) for n in (1, 2))
GAINS = np.array([[0.5, -0.25, 1.0], [0.05, 0.0, 0.0]])  # of inputs by sources


def recorded(runs: int) -> list[np.ndarray]:
    """Two periods of each run, of inputs that are sums of the sources."""
    periods = [MULTISINE.signal(run, periods=3)[round(RATE * 0.5) :] for run in range(runs)]
    return [each[: round(2 * RATE)] @ GAINS.T for each in periods]


def test_all_runs_show_the_sum_over_the_sources() -> None:
    """By hand: the root of 0.25 + 0.0625 + 1 and 0.05, at every frequency."""
    found = levels(MULTISINE, recorded(3), [0, 1])
    exact = 10 * np.log10([0.25 + 0.0625 + 1, 0.0025])
    np.testing.assert_allclose(found, np.tile(exact[:, None], 4), atol=1e-6)


def test_plot_has_a_line_for_each_sensor_and_fits() -> None:
    """The loudest sensor at the highest step, the other 27 dB lower; inputs by their peaks."""
    runs = recorded(3)
    first, second, axis, count = plot(MULTISINE, runs, SENSORS, width=80, height=24).splitlines()
    assert first.count(STEPS[-1]) == 4
    difference = 10 * np.log10((0.25 + 0.0625 + 1) / 0.0025)  # 27.2 dB, in steps of 7.5
    assert second.count(STEPS[int(8 - difference / 7.5)]) == 4
    assert f"{-difference:.1f} dB" in second
    peak = max(np.abs(each[:, 0]).max() for each in runs)
    assert f"{100 * peak:.1f} %" in first
    assert "61 Hz" in axis
    assert count.startswith("3 of 3 runs")
    few = plot(MULTISINE, runs, SENSORS, width=80, height=6).splitlines()
    assert (len(few), "1 more" in few[-1]) == (3, True)


@pytest.mark.parametrize("is_terminal", [True, False])
def test_plot_is_shown_on_a_terminal_only(
    monkeypatch: pytest.MonkeyPatch, is_terminal: bool
) -> None:
    """After the first of three runs."""
    written = io.StringIO()
    console = Console(file=written, force_terminal=is_terminal, width=80, height=24)
    monkeypatch.setattr("rich.console.Console", lambda **_options: console)
    with live_plot(MULTISINE, SENSORS) as show:
        show(recorded(1))
    assert ("1 of 3 runs" in written.getvalue()) == is_terminal
