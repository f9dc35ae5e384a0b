"""A drive's score and level, tone by tone from the forms."""

import numpy as np

from model.drive_modes import Drive, Forms


def by_hand(forms: Forms, drive: Drive) -> tuple[float, float]:
    """Robust score, and amplitude to threshold at the weakest target: powers of tones add."""
    target = np.zeros(len(forms.targets))
    quiet = np.zeros(forms.quiet.shape[1])
    for f, weights in drive:
        w = weights.astype(complex)
        threshold_power = float(forms.threshold[f]) ** 2
        for t, field in enumerate(forms.targets[:, f].astype(complex)):
            target[t] += abs(field @ w) ** 2 / threshold_power
        for q, form in enumerate(forms.quiet[f].astype(complex)):
            quiet[q] += (w.conj() @ form @ w).real / threshold_power
    return float(np.sqrt(target.min() / quiet.max())), float(np.sqrt(target.min()))
