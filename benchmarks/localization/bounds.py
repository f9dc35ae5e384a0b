"""Upper bounds of contrast and robust score: what no drive of a kind can exceed."""

import numpy as np

from model.drive_modes.dual_weights import dual_weights
from model.drive_modes.exact_search import group_magnitudes, group_masks, mean_target_peak
from model.drive_modes.fields import ERROR_SHARE, Fields


def mixture_bound(fields: Fields, *, eras_at_most: int) -> float:
    """Bound of the contrast (a ratio) of any mixture of sources, at any amplitudes.

    A source is a group of up to so many ERAs at one frequency.
    """
    masks = group_masks(fields.era_count, eras_at_most)
    peak = mean_target_peak([group_magnitudes(target, masks) for target in fields.targets]).ravel()
    quiet = group_magnitudes(fields.quiet, masks).reshape(len(peak), -1)
    weights = dual_weights(peak, quiet, is_rms=fields.has_no_quiet_contacts)
    return float((peak / (quiet @ weights)).max())


def robust_bound(fields: Fields, *, rounds: int = 60) -> float:
    """No complex weights at any one frequency have a higher robust score than this.

    The score's square is at most the mean square at the target by w^H R w, for R of any shares of
    the quiet points; its largest value is an eigenvalue. Shares are moved towards the loud points.
    """
    target, quiet = fields.targets[0].astype(complex), fields.quiet.astype(complex)
    reached = target.conj() @ target.transpose(0, 2, 1) / target.shape[2]
    power = np.abs(quiet) ** 2
    shares = np.full((len(quiet), quiet.shape[2]), 1 / quiet.shape[2])
    least = np.full(len(quiet), np.inf)
    for number in range(rounds):
        R = (quiet.conj() * shares[:, None]) @ quiet.transpose(0, 2, 1)
        wrong = ERROR_SHARE**2 * (power @ shares[:, :, None])
        R += wrong * np.eye(R.shape[1])
        values, vectors = np.linalg.eig(np.linalg.solve(R, reached))
        top = values.real.argmax(axis=1)
        least = np.minimum(least, values.real[np.arange(len(R)), top])
        w = np.take_along_axis(vectors, top[:, None, None], axis=2)[:, :, 0]
        loud = np.abs(w[:, None] @ quiet)[:, 0] ** 2
        loud += ERROR_SHARE**2 * ((np.abs(w) ** 2)[:, None] @ power)[:, 0]
        shares *= loud ** (1.0 if number < 5 else 0.7)
        shares /= shares.sum(axis=1, keepdims=True)
    return float(np.sqrt(least.max()))
