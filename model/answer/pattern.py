"""A pattern: an excitation with its predicted measures."""

from dataclasses import dataclass, replace

import numpy as np

from model.finger.perception import DEFAULT_THRESHOLD, highest_measured, sensitivity_margin_db
from model.transients.base_motion import Envelopes
from model.vibration.excitation import Excitation

ONSET_RAMP = 0.040
"""Duration of a plain ramp [s].

Twice what just avoids a click: the slower start gains 4 dB of contrast over the first 100 ms, and
at 20 dB SL the target still feels it after a fifth of it (docs/concepts/transients.md).
"""

IMPERCEPTIBLE_DB_SL = -10.0
"""Level at which a finger stays unaware: ten decibels for the differences between people."""


_LEVELS = ("level_db_sl", "robust_level_db_sl", "quiet_level_db_sl", "robust_quiet_level_db_sl")


@dataclass(frozen=True)
class Concentration:
    """How much of a vibration is near its targets.

    contrast_95_db: targets to the 95th percentile of the plate farther than 50 mm, by peak
    acceleration; area_above_half [m²]: of the plate, targets included, that vibrates more than
    half as strongly as they do; energy_share_near: share of kinetic energy within 50 mm of them.
    """

    contrast_95_db: float
    area_above_half: float
    energy_share_near: float


@dataclass(frozen=True)
class Pattern:
    """An excitation with its ramp [s] and its predicted measures at the fingertips.

    Promised measures (`robust_`) are those that nine of ten plates within the rig's uncertainty
    reach, or at quiet fingers do not exceed. The others are nominal, those of the plate as
    modelled, with the fingers on it.

    - level_db_sl, robust_level_db_sl: at the weakest target; quiet_level_db_sl,
      robust_quiet_level_db_sl: at the loudest quiet point
    - felt_contrast_db, robust_felt_contrast_db, median_felt_contrast_db: level of the target above
      that of the loudest quiet point; contrast_db, robust_contrast_db: the same in peak
      acceleration. All None without quiet fingers

    The rest is None unless computed: surroundings_contrast_db: to the plate farther than 50 mm,
    root mean square, without quiet fingers; transient_contrast_db: over the first 100 ms;
    residual_db: residual vibration in the 100 ms after the end, relative to the steady one
    (`model.answer.timing`). onset, ending: envelopes that replace the ramp. threshold: name of the
    set of thresholds that its levels are above.
    """

    excitation: Excitation
    ramp: float
    level_db_sl: float
    contrast_db: float | None
    quiet_level_db_sl: float | None
    drive_mode: str = "switched"
    robust_level_db_sl: float | None = None
    robust_quiet_level_db_sl: float | None = None
    robust_contrast_db: float | None = None
    robust_felt_contrast_db: float | None = None
    median_felt_contrast_db: float | None = None
    surroundings_contrast_db: float | None = None
    transient_contrast_db: float | None = None
    residual_db: float | None = None
    concentration: Concentration | None = None
    onset: Envelopes | None = None
    ending: Envelopes | None = None
    threshold: str = DEFAULT_THRESHOLD

    @property
    def felt_contrast_db(self) -> float | None:
        """Level of the target above that of the loudest quiet point [dB]."""
        return None if self.quiet_level_db_sl is None else self.level_db_sl - self.quiet_level_db_sl

    @property
    def highest_quiet_level_db_sl(self) -> float | None:
        """Level at the loudest quiet point [dB SL], the promised one where it is known."""
        promised = self.robust_quiet_level_db_sl
        return self.quiet_level_db_sl if promised is None else promised

    @property
    def is_imperceptible_to_quiet(self) -> bool | None:
        """Whether every quiet finger stays 10 dB below the lowest of all sets of thresholds.

        On nine of ten plates. Of several frequencies the one at which that lies lowest counts for
        all.
        """
        highest = self.highest_quiet_level_db_sl
        if highest is None:
            return None
        frequencies = np.array([tone.frequency for tone in self.excitation.values()])
        margin = float(sensitivity_margin_db(frequencies, self.threshold).max(initial=0))
        return highest + margin <= IMPERCEPTIBLE_DB_SL

    @property
    def is_level_extrapolated(self) -> bool:
        """Whether it plays a frequency at which the thresholds are extrapolated."""
        highest = max((tone.frequency for tone in self.excitation.values()), default=0.0)
        return highest > highest_measured(self.threshold)

    @property
    def usable_level_db_sl(self) -> float:
        """Highest level at the target, up to this one, with quiet fingers at -10 dB SL.

        On nine of ten plates, by the pattern's own thresholds: no claim that they feel nothing.
        """
        highest = self.highest_quiet_level_db_sl
        if highest is None:
            return self.level_db_sl
        return min(self.level_db_sl, self.level_db_sl - highest + IMPERCEPTIBLE_DB_SL)

    def scaled(self, gain_db: float) -> "Pattern":
        """The pattern louder by so much [dB]: contrasts stay."""
        factor = 10 ** (gain_db / 20)
        levels = {
            name: value + gain_db for name in _LEVELS if (value := getattr(self, name)) is not None
        }
        excitation = {
            name: replace(tone, amplitude=tone.amplitude * factor)
            for name, tone in self.excitation.items()
        }
        return replace(self, excitation=excitation, **levels)
