"""Calibration of a rig by responses measured on it."""

from pathlib import Path

from era_haptics.arguments import expect_rig
from model.calibration.calibrate import Calibration
from model.calibration.calibrate import calibrate as fit
from model.calibration.responses import read_measured, responses_of
from model.diagnosis.verdict import check_consistency
from model.errors import expect_path
from model.processes import Progress, check_progress, unseen
from model.rig.rig import Rig


def calibrate(
    rig: Rig, measured: Path | str, *, all_scales: bool = False, progress: Progress = unseen
) -> Calibration:
    """Fit a rig to measured responses, a .csv, .uff or .unv file, as `era calibrate` does.

    all_scales: estimate the scale of every sensor, not only of wrong ones; progress: called with
    the fits done and all. The result's `rig` has the fitted values and their uncertainty, its
    `parameters` their standard errors; use it only if `is_good`. Raises InputError for responses
    that are not what they claim, by their cause.

    Example:
        >>> fit = era.calibrate(rig, "examples/measured.csv")
        >>> fit.is_good
        True
    """
    expect_rig(rig)
    check_progress(progress)
    responses = responses_of(read_measured(expect_path(measured, what="measured")), rig)
    screened = check_consistency(rig, responses)
    return fit(rig, responses, screened, all_scales=all_scales, progress=progress)
