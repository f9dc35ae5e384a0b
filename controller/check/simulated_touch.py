"""One touch of an effect simulated in time: what the finger feels, and what a resting one does."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from controller.play.intent import Target
from controller.play.joint_answers import answered
from controller.play.routing import RAMPS_ONLY, PlaybackCapabilities
from controller.play.selection import Chooser
from controller.sources.touch import Contact, ContactKey
from model.answer.answer import Answer, Limits
from model.answer.answer_report import exposures
from model.arrays import NEARLY, FloatArray
from model.drive_modes import DRIVE_MODES
from model.errors import InputError
from model.finger import decibels, fingertip_points, fingertip_weights, over_threshold
from model.structure.attachments import fingertip_loads
from model.table.table import LocalizationTable
from model.transients.base_motion import Bases, ramped_pulse
from model.transients.shaping import SAMPLE_RATE, Transients
from model.transients.time_response import PlateInTime, plate_in_time
from model.vibration import base_amplitudes

Position = tuple[float, float]

STEADY_AFTER, STEADY_FOR = 0.3, 0.1
"""Start and length [s] of the part over which a vibration without a duration is felt."""

_AFTER = 0.1  # s; what a resting finger feels after the end counts, too


@dataclass(frozen=True)
class SimulatedTouch:
    """A touch at a position [m], with a resting finger [m] or None.

    frequencies [Hz]; felt_db_sl: over the duration of the effect; resting_db_sl: the strongest that
    the resting finger feels over as long, None without one; promised_contrast_db: over that finger
    on nine of ten plates; held_back_db: by how much it is weaker for that finger; exposure_m_s2: of
    it at full strength (`exposures`); reason: why nothing plays.
    """

    at: Position
    resting: Position | None
    frequencies: tuple[float, ...] = ()
    felt_db_sl: float | None = None
    resting_db_sl: float | None = None
    promised_contrast_db: float | None = None
    reason: str | None = None
    held_back_db: float = 0.0
    exposure_m_s2: float = 0.0


def loaded_plate(table: LocalizationTable, contacts: Sequence[Position]) -> PlateInTime:
    """A table's plate in time with fingers on it, if they weigh anything."""
    if table.fingertip is None:
        return table.in_time
    loads = fingertip_loads(table.fingertip, contacts)
    return plate_in_time(table.in_time.reduced, table.eras, loads=table.masses, contacts=loads)


class TouchSimulator:
    """Plays effects as the controller does, along plain ramps, on the plate of a table in time.

    The fingers weigh on it.
    """

    def __init__(self, table: LocalizationTable) -> None:
        self.table = table
        self.chooser = Chooser(table)
        """Chooses what is played beside other contents."""
        self.capabilities = PlaybackCapabilities(
            drive_mode=DRIVE_MODES[-1],
            playable=DRIVE_MODES,
            limits=Limits((float(table.frequencies[0]), float(table.frequencies[-1]))),
            envelope_support=RAMPS_ONLY,
        )
        """Of amplifiers that play whatever the table has."""

    def answered(self, target: Target, at: Position, quiet: Sequence[Position]) -> Answer:
        """Answer a target at a position [m] among quiet fingers, along plain ramps.

        Raises InputError where nothing can be played.
        """
        finger = Contact(target.key, *at, since=0.0)
        others = [
            Contact(ContactKey("quiet", number), *place, since=0.0)
            for number, place in enumerate(quiet)
        ]
        return answered(self.table, [(finger, target)], others, self.capabilities, before={})

    def touch(self, target: Target, at: Position, resting: Position | None) -> SimulatedTouch:
        """Play a target's content at a finger."""
        try:
            answer = self.answered(target, at, [] if resting is None else [resting])
        except InputError as error:
            return SimulatedTouch(at, resting, reason=str(error))
        layer, pulse, expected = answer.layers[0], target.pulse, answer.fingers[0]
        is_whole = pulse is not None and pulse.is_raised
        since = 0.0 if is_whole else STEADY_AFTER
        duration = pulse.duration if pulse is not None and is_whole else STEADY_FOR
        end, eras = since + duration, self.table.eras
        bases = ramped_pulse(layer.excitation, eras, ramp=layer.ramp, duration=end)
        transients = Transients(
            loaded_plate(self.table, [at] if resting is None else [at, resting])
        )
        felt = self._levels_at(transients, at, bases, length=duration, until=end)
        level = float(felt[round(since * SAMPLE_RATE)])
        resting_level = promised = None
        if resting is not None:
            over = self._levels_at(transients, resting, bases, length=duration, until=end + _AFTER)
            resting_level = float(over[round(since * SAMPLE_RATE) :].max())
            promised = expected.promised_contrast_db
        return SimulatedTouch(
            at,
            resting,
            tuple(base_amplitudes(layer.excitation, eras)[0].tolist()),
            level,
            resting_level,
            promised,
            held_back_db=0.0 if answer.stroke_factor < 1 - NEARLY else expected.lowered_db,
            exposure_m_s2=exposures(self.table, answer)[0],
        )

    def _levels_at(
        self,
        transients: Transients,
        at: Position,
        bases: Bases,
        *,
        length: float,
        until: float,
    ) -> FloatArray:
        """Level [dB SL] of the rms over each stretch of a length [s] up to a time [s], (n,).

        Mean over a fingertip; one value for each sample at which a stretch starts.
        """
        plate = self.table.plate
        points, weights = fingertip_points(*at, plate), fingertip_weights(*at, plate)
        acceleration = transients.acceleration(bases, points, duration=until)
        felt = over_threshold(acceleration, SAMPLE_RATE, self.table.threshold)
        total = np.vstack([np.zeros(len(points)), np.cumsum(felt**2, axis=0)])
        count = min(round(length * SAMPLE_RATE), len(total) - 1)
        mean = np.maximum((total[count:] - total[:-count]) / count, 0.0)
        return decibels(math.sqrt(2) * np.sqrt(mean) @ weights)
