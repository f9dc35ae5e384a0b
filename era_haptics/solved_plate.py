"""The plate of a rig, solved once: modes, maps, and playback in time."""

from collections.abc import Sequence
from functools import cached_property
from typing import cast

import numpy as np

from era_haptics.arguments import (
    Fingers,
    Positions,
    as_fingers,
    as_frequencies,
    as_loads,
    as_pair,
    as_points,
    as_signals,
    expect_rig,
)
from era_haptics.drive import Played, excitation_of, layer_of
from model.answer.answer import Answer, Layer
from model.answer.fingers import Placement, check_on_plate
from model.answer.over_duration import ONSET_RAMP
from model.arguments import expect_number, is_whole, shown
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.reduction.reduced_plate import (
    ReducedPlate,
    SupportedModes,
    reduce_free_plate,
    supported_modes,
)
from model.rig.rig import Rig
from model.structure.attachments import check_loads, footprints_of
from model.table.table import default_drive_frequencies
from model.vibration.excitation import Excitation, Tone
from model.vibration.maps import PlateMap, plate_map
from sim.plant.excited_plate import Playback, play, play_signals
from sim.plant.imperfections import Imperfections, draw_of_ensemble


class SolvedPlate:
    """A rig's plate on its ERAs, up to the highest frequency of the rig's limits.

    seed: of a plate, ERAs, channels and fingers drawn within the rig's uncertainty, as those on
    which `era table verify` checks promises, on another mesh; None for the rig's own. Solved once,
    at the first use, in some hundredths of a second.
    """

    def __init__(self, rig: Rig, *, seed: int | None = None) -> None:
        expect_rig(rig)
        self.rig = rig
        self._drawn = Imperfections()
        if seed is not None:
            if not is_whole(seed) or seed < 0:
                raise InputError(f"seed must be a whole number of at least 0, got {shown(seed)}")
            self._drawn = draw_of_ensemble(rig, seed=int(seed))
        self._real = self._drawn.plate.realised(rig)

    def __repr__(self) -> str:
        plate = self.rig.plate
        eras = ", ".join(era.name for era in self.rig.eras)
        return f"<SolvedPlate of {plate.length:g} x {plate.width:g} m on ERAs {eras}>"

    @cached_property
    def modes(self) -> SupportedModes:
        """Natural frequencies (n,) [Hz], damping ratios (n,), and shapes anywhere by `at`.

        Up to the highest frequency of the rig's limits, as `era plate modes`. Raises InputError
        for a plate that is not supported.
        """
        rig = self._real
        return supported_modes(
            self._reduced, rig.eras, loads=rig.masses, frequency_max=rig.limits.frequency_max
        )

    def responses(
        self,
        points: Positions,
        frequencies: Sequence[float] | FloatArray | None = None,
        *,
        fingers: Fingers = (),
        seed: int | None = None,
    ) -> ComplexArray:
        """Compute the acceleration [m/s²] at points by each ERA alone at full stroke.

        points (p, 2) [m]; frequencies (f,) [Hz]: those of a table by default; fingers: that rest on
        the plate, as positions [m] or with their loads; seed: of a drawn plate, whose responses
        those of `SolvedPlate(rig, seed=seed)` are. Returns complex amplitudes (f, ERAs, p), ERAs as
        in `rig.eras`; phases are those of exp(+i omega t), as a tone's. With weights w (f, ERAs) in
        full strokes the field is their product, as in `map`. Raises InputError for points and
        fingers off the plate, and frequencies for which it is not solved.
        """
        if seed is not None:
            drawn = SolvedPlate(self.rig, seed=seed)
            return drawn.responses(points, frequencies, fingers=fingers)
        rig, resting = self._real, as_fingers(fingers, what="fingers")
        contacts, loads = [each.at for each in resting], [each.load for each in resting]
        places = as_points(points, what="points")
        for what, each in (("point", places), ("finger", contacts)):
            check_on_plate(what, each, rig.plate)
        check_loads(loads)
        tones = default_drive_frequencies(rig.limits)
        if frequencies is not None:
            tones = as_frequencies(frequencies)
        self._check_frequency(tones.max())
        found = self._free.acceleration(
            rig.eras,
            tones,
            np.reshape(places, (-1, 2)),
            loads=[*rig.masses, *self._drawn.resting(self.rig, contacts, loads)],
        )
        return found * self._factors[:, None]

    def map(self, drive: Played, *, raster: tuple[int, int] | None = None) -> PlateMap:
        """Compute the steady peak acceleration [m/s²] over the plate, and its nulls.

        raster: number of points along x and y, by default enough for all that the mesh resolves.
        ERAs at one frequency add as complex amplitudes, magnitudes of several frequencies add
        (paper Eq. 28). Raises InputError for a drive that the rig cannot play.
        """
        points = (
            None
            if raster is None
            else as_pair(raster, what="raster", such_as="points along x and y such as (61, 46)")
        )
        excitation = {}
        for name, tone in self._excitation(drive).items():
            factor = self._drawn.errors_of(name, self.rig).factor
            excitation[name] = Tone.from_phasor(tone.frequency, factor * tone.phasor)
        return plate_map(self._real, excitation, raster=points, free=self._free)

    def play(
        self,
        drive: Played | FloatArray,
        target: Positions,
        *,
        quiet: Positions = (),
        loads: Sequence[float] = (),
        duration: float = 1.0,
        sample_rate: float | None = None,
    ) -> Playback:
        """Compute what fingers at positions [m] feel during a duration [s], from rest.

        A layer starts with its onset or its ramp, other drives with a ramp of 40 ms. Fingers
        load the plate as the rig's fingertip; loads: of each relative to it, targets first, 1
        without. The plate in time is solved exactly, without steps
        (`docs/concepts/plant.md`). With a sample_rate [Hz] drive is an array (ERAs, samples) of
        band-limited signals in full strokes, -1 to 1, which say the duration, and records have
        their samples; append zeros to let the plate ring on. Raises InputError for fingers off the
        plate, a duration too short for a steady state, and signals that no ERA can play.
        """
        expect_number(duration, what="duration", unit="seconds")
        fingers = Placement(
            as_points(target, what="target"),
            as_points(quiet, what="quiet"),
            loads=as_loads(loads),
        )
        if isinstance(drive, np.ndarray) or sample_rate is not None:
            return play_signals(
                self.rig,
                self._reduced,
                as_signals(drive, self.rig, sample_rate),
                fingers,
                sample_rate=cast(float, sample_rate),
                imperfections=self._drawn,
            )
        layer = layer_of(drive) if isinstance(drive, Answer | Layer) else None
        return play(
            self.rig,
            self._reduced,
            self._excitation(drive),
            fingers,
            duration=duration,
            ramp=layer.ramp if layer else ONSET_RAMP,
            onset=layer.onset if layer else None,
            imperfections=self._drawn,
        )

    def _excitation(self, drive: Played) -> Excitation:
        """The excitation; raises InputError beyond the frequencies that the plate is solved for."""
        excitation = excitation_of(drive, self.rig)
        for name, tone in excitation.items():
            self._check_frequency(tone.frequency, of=f" of {name}")
        return excitation

    def _check_frequency(self, frequency: float, *, of: str = "") -> None:
        """Raise InputError for a frequency [Hz] beyond those that the plate is solved for."""
        highest = self.rig.limits.frequency_max
        if frequency > highest:
            raise InputError(
                f"frequency{of} must be at most {highest:g} Hz, got {frequency:g}; "
                "raise limits.frequency of the rig"
            )

    @cached_property
    def _factors(self) -> ComplexArray:
        """Gain and phase of each ERA's channel, (eras,)."""
        errors = (self._drawn.errors_of(era.name, self.rig) for era in self.rig.eras)
        return np.array([each.factor for each in errors])

    @cached_property
    def _free(self) -> FreePlate:
        rig = self._real
        return solve_free_plate(rig.plate, rig.mesh, frequency_max=rig.limits.frequency_max)

    @cached_property
    def _reduced(self) -> ReducedPlate:
        attached = footprints_of(self._real.eras, self._real.masses)
        return reduce_free_plate(self._free, attached)
