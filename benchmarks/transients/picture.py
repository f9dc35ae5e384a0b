"""What a target and a quiet finger feel at the start and at the end of a vibration, drawn."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.transients.cases import Case
from model.answer.stimulus import ONSET_RAMP
from model.arrays import FloatArray
from model.finger import contrast_db, fingertip_points, fingertip_weights
from model.rig.rig import Rig
from model.transients.base_motion import Bases, ramped_ending, ramped_onset, shaped
from model.transients.shaping import SAMPLE_RATE, Shaper, Transients
from model.transients.time_response import PlateInTime

LASTS = 0.160  # s
RAMPED = f"{1e3 * ONSET_RAMP:.0f} ms ramp"


def draw(plate: PlateInTime, rig: Rig, cases: list[list[Case]], path: Path) -> None:
    """The pair whose steady contrast is the median one, started and stopped in three ways."""
    by_contrast = sorted(
        (patterns[0] for patterns in cases), key=lambda case: case.steady_db(case.weights)
    )
    case = by_contrast[len(by_contrast) // 2]
    excitation = case.excitation(rig, case.felt_level)
    shaper, transients = (
        Shaper(plate, gain_variance=rig.uncertainty.gain_variance),
        Transients(plate),
    )
    onset = shaper.onset(excitation, targets=case.targets, quiet=case.quiet)
    ending = shaper.ending(excitation, targets=case.targets, quiet=case.quiet)
    rows: list[tuple[str, Bases, str, Bases]] = [
        (
            "abrupt",
            ramped_onset(excitation, rig.eras, ramp=0.0),
            "stopped at once",
            ramped_ending(excitation, rig.eras, ramp=0.0),
        ),
        (
            RAMPED,
            ramped_onset(excitation, rig.eras, ramp=ONSET_RAMP),
            RAMPED,
            ramped_ending(excitation, rig.eras, ramp=ONSET_RAMP),
        ),
        ("shaped", shaped(onset, rig.eras), "shaped, quietly", shaped(ending, rig.eras)),
    ]
    points = [fingertip_points(*each, rig.plate) for each in case.contacts]
    weights = fingertip_weights(*case.contacts[0], rig.plate)
    count = len(weights)
    figure = Figure(figsize=(10, 7), layout="constrained")
    axes = figure.subplots(3, 2, sharex=True, sharey="col")
    for (left, right), (start_name, start, end_name, end) in zip(axes, rows, strict=True):
        for axis, name, felt in (
            (
                left,
                start_name,
                transients.acceleration(start, np.concatenate(points), duration=LASTS),
            ),
            (
                right,
                end_name,
                transients.acceleration(
                    end, np.concatenate(points), duration=LASTS, after=excitation
                ),
            ),
        ):
            times = 1e3 * np.arange(len(felt)) / SAMPLE_RATE
            quiet = felt[:, count:]
            loudest = int(np.abs(quiet).max(axis=0).argmax())
            axis.plot(times, felt[:, 0], color="0.65", linewidth=0.8, label="target")
            axis.plot(times, quiet[:, loudest], color="C3", linewidth=1.0, label="quiet finger")
            axis.set_title(f"{name}: {_remark(felt, weights, start=axis is left)}", fontsize=10)
            axis.grid(alpha=0.3)
        left.set_ylabel("acceleration in m/s²")
    axes[0, 0].legend(loc="upper right", fontsize=9)
    for axis, what in zip(axes[-1], ("start", "end"), strict=True):
        axis.set_xlabel(f"time after the {what} in ms")
    figure.suptitle(
        f"{case.frequency:.0f} Hz at 20 dB SL, steady contrast "
        f"{case.steady_db(case.weights):.0f} dB; quiet finger at its loudest point",
        fontsize=11,
    )
    figure.savefig(path, dpi=110)


def _remark(felt: FloatArray, weights: FloatArray, *, start: bool) -> str:
    if start:
        peak = np.abs(felt[: round(0.1 * SAMPLE_RATE)]).max(axis=0)
        contrast = contrast_db([peak[: len(weights)]], peak[len(weights) :], [weights])
        return f"contrast {contrast:.0f} dB in the first 100 ms"
    late = np.abs(felt[round(0.04 * SAMPLE_RATE) :, : len(weights)]).max()
    return f"target moves up to {late:.2g} m/s² after 40 ms"
