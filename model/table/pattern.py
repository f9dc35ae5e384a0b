"""A pattern: what the table answers, an excitation with what it is predicted to do."""

from dataclasses import dataclass

from model.transients.envelope import Envelopes
from model.vibration.excitation import Excitation

ONSET_RAMP = 0.040
"""How long [s] a plain ramp lasts.

At 20 dB SL the target feels it after a fifth of that, and half of it after half; twice as long as
what just does not click, since a plate that is stirred less rings less at the quiet fingers: 4 dB
of contrast over the first 100 ms (docs/concepts/transients.md).
"""

UNAWARE_DB_SL = -10.0
"""At this level and below even the most sensitive quiet finger feels nothing."""


@dataclass(frozen=True)
class Spread:
    """How a vibration lies over the plate, relative to what its targets feel.

    contrast_95_db: from the targets to what 95 % of the plate farther than 50 mm stays below, by
    peak acceleration; area_above_half [m²]: of the plate where it is more than half as strong as
    at the targets, these included; energy_share_near: of its kinetic energy, within 50 mm of them.
    """

    contrast_95_db: float
    area_above_half: float
    energy_share_near: float


@dataclass(frozen=True)
class Pattern:
    """An excitation with its ramp [s] and what it is predicted to do at the fingertips.

    level_db_sl: at the target, at the lesser one of several; contrast_db: from the target to the
    loudest quiet point, by peak acceleration; quiet_level_db_sl: at the loudest quiet point;
    surroundings_contrast_db: to the plate farther than 50 mm, root mean square. None: the first two
    about quiet fingers where there are none, the last where there are. contrast_bound_db: what no
    pattern of the kind exceeds, where it was searched for exactly
    (`model.drive_modes.exact_search`). robust_contrast_db: tenth percentile of the contrast over
    what may differ on the real plate (`model.table.robust`); transient_contrast_db: over the first
    100 ms; left_after_db: vibration of the plate in the 100 ms after the end, relative to the
    steady one (`model.table.timing` for both); spread: over the plate, of what is told from its
    surroundings (`model.table.spread`); None unless asked for. onset, ending: envelopes in place of
    the ramp, for amplifiers that play them.
    """

    excitation: Excitation
    ramp: float
    level_db_sl: float
    contrast_db: float | None
    quiet_level_db_sl: float | None
    mode: str = "switched"
    surroundings_contrast_db: float | None = None
    contrast_bound_db: float | None = None
    robust_contrast_db: float | None = None
    transient_contrast_db: float | None = None
    left_after_db: float | None = None
    spread: Spread | None = None
    onset: Envelopes | None = None
    ending: Envelopes | None = None

    @property
    def contrast_db_sl(self) -> float | None:
        """How far the target's level is above the loudest quiet point's [dB]."""
        return None if self.quiet_level_db_sl is None else self.level_db_sl - self.quiet_level_db_sl

    @property
    def quiet_is_unaware(self) -> bool | None:
        """Whether no quiet finger feels anything, with 10 dB to spare."""
        return None if self.quiet_level_db_sl is None else self.quiet_level_db_sl <= UNAWARE_DB_SL

    @property
    def usable_level_db_sl(self) -> float:
        """The highest level at the target, up to this one, that leaves quiet fingers unaware."""
        if self.contrast_db_sl is None:
            return self.level_db_sl
        return min(self.level_db_sl, self.contrast_db_sl + UNAWARE_DB_SL)
