"""Simulate in time how a touch feels on a table's plate, as the controller plays it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from controller.play.chooser import Chooser
from controller.play.intent import FingerTarget, Target
from controller.play.joint_answers import answered
from controller.play.selected_contents import Question
from controller.play.shared_capabilities import RAMPS_ONLY, PlaybackCapabilities
from controller.sources.touch import Contact, ContactKey
from model.answer.answer import Answer, Limits
from model.answer.answer_report import exposures
from model.arrays import NEARLY, FloatArray, Point
from model.drive_modes import DRIVE_MODES, UNRESTRICTED
from model.errors import InputError
from model.finger import decibels, fingertip_points, fingertip_weights, over_threshold
from model.structure.fingertips import fingertip_loads
from model.table.table import LocalizationTable
from model.transients.base_motion import Bases, ramped_pulse
from model.transients.plate_in_time import PlateInTime, plate_in_time
from model.transients.shaping import SAMPLE_RATE, Transients
from model.vibration import base_amplitudes

STEADY_AFTER = 0.3
"""Start [s] of the interval over which a continuous vibration is evaluated."""

STEADY_FOR = 0.1
"""Length [s] of that interval."""

_AFTER = 0.1  # s; the vibration of a resting finger counts until then


@dataclass(frozen=True)
class SimulatedTouch:
    """Simulated touch at a position [m], with a resting second finger [m] or None.

    - frequencies [Hz]
    - felt_db_sl: level over the duration of the effect.
    - resting_db_sl: highest level at the resting finger over an equally long interval; None without
      one.
    - promised_contrast_db: contrast with the resting finger on 90 % of plates.
    - held_back_db: reduction of the level for the resting finger's sake.
    - exposure_m_s2: weighted acceleration at full strength (`exposures`).
    - reason: why nothing plays.
    """

    at: Point
    resting: Point | None
    frequencies: tuple[float, ...] = ()
    felt_db_sl: float | None = None
    resting_db_sl: float | None = None
    promised_contrast_db: float | None = None
    reason: str | None = None
    held_back_db: float = 0.0
    exposure_m_s2: float = 0.0


def loaded_plate(table: LocalizationTable, contacts: Sequence[Point]) -> PlateInTime:
    """Return a table's plate in the time domain, loaded by fingers unless they are massless."""
    if table.fingertip is None:
        return table.in_time
    loads = fingertip_loads(table.fingertip, contacts)
    return plate_in_time(table.in_time.reduced, table.eras, loads=table.masses, contacts=loads)


class TouchSimulator:
    """Play effects as the controller does, with plain ramps, on a table's plate loaded by the
    fingers.
    """

    def __init__(self, table: LocalizationTable) -> None:
        self.table = table
        self.chooser = Chooser(table)
        """Chooses frequencies and weights with other contents present."""
        self.capabilities = PlaybackCapabilities(
            drive_mode=UNRESTRICTED,
            playable=DRIVE_MODES,
            limits=Limits((float(table.frequencies[0]), float(table.frequencies[-1]))),
            envelope_support=RAMPS_ONLY,
        )
        """Limits of amplifiers that can play the whole table."""

    def answered(self, target: Target, at: Point, quiet: Sequence[Point]) -> Answer:
        """Answer a target at a position [m] with quiet fingers, using plain ramps.

        Raises InputError if nothing can be played.
        """
        contacts = [Contact(target.key, *at, since=0.0)]
        for number, position in enumerate(quiet):
            contacts.append(Contact(ContactKey("quiet", number), *position, since=0.0))
        finger = FingerTarget(contacts[0], target)
        question = Question(tuple(contacts), (finger,), ())
        return answered(self.table, question, question.lasting, self.capabilities)

    def touch(self, target: Target, at: Point, resting: Point | None) -> SimulatedTouch:
        """Play a target's content at a finger."""
        quiet = [] if resting is None else [resting]
        try:
            answer = self.answered(target, at, quiet)
        except InputError as error:
            return SimulatedTouch(at, resting, reason=str(error))
        layer = answer.layers[0]
        sensation = answer.fingers[0]
        eras = self.table.eras
        start, duration = _evaluated_interval(target)
        end = start + duration
        first_sample = round(start * SAMPLE_RATE)
        bases = ramped_pulse(layer.excitation, eras, ramp=layer.ramp, duration=end)
        transients = Transients(loaded_plate(self.table, [at, *quiet]))
        felt_levels = self._levels_at(transients, at, bases, length=duration, until=end)
        resting_level = promised_contrast = None
        if resting is not None:
            resting_levels = self._levels_at(
                transients, resting, bases, length=duration, until=end + _AFTER
            )
            resting_level = float(resting_levels[first_sample:].max())
            promised_contrast = sensation.promised_contrast_db
        frequencies = base_amplitudes(layer.excitation, eras)[0]
        is_at_limit = answer.stroke_factor < 1 - NEARLY
        return SimulatedTouch(
            at,
            resting,
            tuple(frequencies.tolist()),
            float(felt_levels[first_sample]),
            resting_level,
            promised_contrast,
            held_back_db=0.0 if is_at_limit else sensation.lowered_db,
            exposure_m_s2=exposures(self.table, answer)[0],
        )

    def _levels_at(
        self,
        transients: Transients,
        at: Point,
        bases: Bases,
        *,
        length: float,
        until: float,
    ) -> FloatArray:
        """Level [dB SL] of the RMS over each window of `length` [s] that ends before `until` [s],
        (n,).

        Averaged over a fingertip; one value per sample at which a window starts.
        """
        plate = self.table.plate
        points, weights = fingertip_points(*at, plate), fingertip_weights(*at, plate)
        acceleration = transients.acceleration(bases, points, duration=until)
        felt = over_threshold(acceleration, SAMPLE_RATE, self.table.threshold)
        total = np.vstack([np.zeros(len(points)), np.cumsum(felt**2, axis=0)])
        count = min(round(length * SAMPLE_RATE), len(total) - 1)
        mean = np.maximum((total[count:] - total[:-count]) / count, 0.0)
        return decibels(math.sqrt(2) * np.sqrt(mean) @ weights)


def _evaluated_interval(target: Target) -> tuple[float, float]:
    """Return start and length [s] of the interval over which a target's vibration is evaluated."""
    pulse = target.pulse
    if pulse is not None and pulse.is_raised:
        return 0.0, pulse.duration
    return STEADY_AFTER, STEADY_FOR
