"""`era measure` with sensors that stay: all of them at once, and the report."""

from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from model.calibration.responses_file import write_responses
from model.commands.options import Stopwatch, progress_bar
from sim.desk.measuring.desk import Desk
from sim.desk.measuring.live_plot import live_plot
from sim.desk.measuring.measure import Measured, check_by_steps, measure
from sim.desk.measuring.multisine import Multisine
from sim.desk.measuring.sound_card import SoundCard


def measure_at_once(
    desk: Desk,
    opened: AbstractContextManager[tuple[SoundCard, Multisine]],
    output: Path,
    *,
    periods: int,
    is_stepped: bool,
) -> tuple[list[str], dict[str, Any]]:
    """Measure, write the responses, and return the report; is_stepped: with single tones, too.

    Raises InputError, LinkError, OSError.
    """
    check = None
    with Stopwatch() as timed, opened as (card, multisine):
        with live_plot(multisine, desk.sensors) as show:
            found = measure(desk, card, multisine, periods=periods, show=show)
        if is_stepped:
            with progress_bar("tones") as progress:
                check = check_by_steps(desk, card, found, level=multisine.level, progress=progress)
    write_responses(output, found.responses, desk.rig)
    written = f"measured in {timed.elapsed:.1f} s; wrote {output}"
    return [*_rows(found, check, rate=card.rate), written], {
        "frequencies_hz": found.responses.frequencies.tolist(),
        "latency_s": found.latency,
        "repeated_runs": found.repeated,
        "sensors": {name: found.quality(n) for n, name in enumerate(found.responses.sensors)},
        "stepped": check,
        "measure_time_s": timed.elapsed,
        "files": [str(output)],
    }


def _rows(found: Measured, check: dict[str, Any] | None, *, rate: float) -> Iterator[str]:
    """Yield how well responses were measured."""
    lines = found.responses.frequencies
    yield (
        f"{len(lines)} frequencies from {lines[0]:g} to {lines[-1]:g} Hz; delay of the sound card "
        f"{1e3 * found.latency:.3f} ms ({found.latency * rate:.1f} samples); "
        f"{found.repeated} runs repeated for lost blocks"
    )
    yield "sensor      coherence   lowest   noise    square law"
    for n, name in enumerate(found.responses.sensors):
        yield (
            f"{name:10s} {np.median(found.coherence[:, n]):10.4f} "
            f"{found.coherence[:, n].min():8.4f} {100 * np.median(found.std[:, n]):6.2f} % "
            f"{100 * found.even[n]:8.2f} %"
        )
    if check is not None:
        yield (
            "stepped tones differ by {level_rms_db:.3f} dB rms, {level_max_db:.2f} dB at most, and "
            "{phase_rms_deg:.2f}° rms, {phase_max_deg:.1f}° at most".format(**check)
        )
