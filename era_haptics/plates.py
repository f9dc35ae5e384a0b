"""Solved plate of a rig: modes, acceleration maps, playback in time, and their pictures.

Pictures are matplotlib figures, made without pyplot.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from era_haptics.drive import (
    MAX_LEVEL,
    Fingers,
    Played,
    Positions,
    as_fingers,
    as_frequencies,
    as_loads,
    as_pair,
    as_points,
    as_signals,
    expect_rig,
    playable_layers,
    warn_of_surface,
)
from model.answer.answer import Answer
from model.answer.stimulus import Placement, Stimulus, check_on_plate, together
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError, expect_instance, expect_number, is_whole, shown
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.reduction.reduced_plate import ReducedPlate, reduce_free_plate
from model.reduction.supported_plate import SupportedModes, supported_modes
from model.rig.rig import Rig
from model.structure.attachments import footprints_of
from model.structure.fingertips import check_loads
from model.study.contrast_maps import ContrastMap
from model.table.table import LocalizationTable, default_drive_frequencies
from model.vibration import FrequencySweep, PlateMap, Tone, plate_map
from sim.plant.excited_plate import play, play_signals
from sim.plant.fingers import FingerRecord
from sim.plant.imperfections import Imperfections, draw_of_ensemble
from sim.plant.plate_playback import LEVEL_WINDOW, PlatePlayback

if TYPE_CHECKING:  # slow to import, like all drawing modules
    from matplotlib.figure import Figure


class SolvedPlate:
    """A rig's plate on its ERAs, solved once at first use, up to the rig's highest frequency.

    seed: of a plate, ERAs, channels and fingers drawn at random from the rig's tolerances and
    solved on another mesh, like `era table verify`; None for the nominal rig.

    Example:
        >>> plate = era.SolvedPlate(rig)
        >>> plate.modes.natural_frequencies[:3].round(1).tolist()
        [31.6, 67.9, 75.5]
    """

    def __init__(self, rig: Rig, *, seed: int | None = None) -> None:
        expect_rig(rig)
        warn_of_surface(rig)
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
        """Natural frequencies (n,) [Hz], damping ratios (n,), and mode shapes at any point (`at`).

        The modes extend to the highest frequency of the rig's limits, like `era plate modes`.
        Raises InputError for a plate without supports.
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
        """Compute the acceleration [m/s²] at points for each ERA alone at full stroke.

        - points (p, 2) [m].
        - frequencies (f,) [Hz]: default: the frequencies of a table.
        - fingers: fingers that rest on the plate, as positions [m] or as `Finger`s with their
          loads.
        - seed: for a plate drawn at random, like `SolvedPlate(rig, seed=seed)`.

        Returns complex peak amplitudes h (f, ERAs, p), with ERAs in the order of `rig.eras`:
        weights w (1 = full stroke) give a(t) = Im[h w exp(i omega t)], which without fingers is the
        field of `map`. Raises InputError for points and fingers off the plate, and for frequencies
        outside the solved range.

        Example:
            >>> plate.responses([(0.08, 0.06), (0.22, 0.16)], [110, 240]).shape
            (2, 4, 2)
        """
        if seed is not None:
            drawn = SolvedPlate(self.rig, seed=seed)
            return drawn.responses(points, frequencies, fingers=fingers)
        resting = as_fingers(fingers, what="fingers")
        positions = as_points(points, what="points")
        check_on_plate("point", positions, self._real.plate)
        check_on_plate("finger", [finger.at for finger in resting], self._real.plate)
        check_loads([finger.load for finger in resting])
        if frequencies is None:
            hertz = default_drive_frequencies(self.rig.limits)
        else:
            hertz = as_frequencies(frequencies)
        accelerations = self._free.acceleration(
            self._real.eras,
            hertz,
            np.reshape(positions, (-1, 2)),
            loads=[*self._real.masses, *self._drawn.resting(self.rig, resting)],
        )
        return accelerations * self._drawn.factors(self.rig)[:, None]

    def sweep(
        self,
        weights: Mapping[str, complex],
        points: Positions,
        frequencies: Sequence[float] | FloatArray | None = None,
        *,
        fingers: Fingers = (),
    ) -> FrequencySweep:
        """Compute the acceleration [m/s²] at points while ERAs play together, at each frequency.

        - weights: of ERAs by name; a magnitude of 1 is full stroke. Other ERAs are silent.
        - points, frequencies, fingers: as for `responses`.

        Raises InputError for unknown ERAs, for magnitudes above 1, and as `responses`.

        Example:
            >>> swept = plate.sweep({"SW": 1, "NE": -1}, (0.08, 0.06), range(60, 321, 10))
            >>> f"strongest at {swept.frequencies[abs(swept.acceleration[:, 0]).argmax()]:.0f} Hz"
            'strongest at 320 Hz'
        """
        for name, weight in weights.items():
            self.rig.era(name)
            if not abs(weight) <= MAX_LEVEL:
                raise InputError(f"weight of {name} must be at most 1 (full stroke), got {weight}")
        hertz = as_frequencies(
            default_drive_frequencies(self.rig.limits) if frequencies is None else frequencies
        )
        responses = self.responses(points, hertz, fingers=fingers)
        row = np.array([complex(weights.get(era.name, 0.0)) for era in self.rig.eras])
        return FrequencySweep(
            frequencies=hertz,
            points=np.reshape(as_points(points, what="points"), (-1, 2)),
            acceleration=np.asarray(np.einsum("e,fep->fp", row, responses)),
        )

    def map(self, drive: Played, *, raster: tuple[int, int] | None = None) -> PlateMap:
        """Compute the steady peak acceleration [m/s²] over the plate, and its nulls.

        raster: number of points along x and y; default: as many as the mesh resolves. All layers of
        an answer are included. Fingers do not load the plate here, although their load moves nulls
        (`responses` and `play` include it). ERAs at one frequency add as complex amplitudes; the
        magnitudes of different frequencies add (paper Eq. 28). Raises InputError for a drive that
        the rig cannot play.

        Example:
            >>> field = plate.map({"SW": 110, "NE": era.Drive(110, level=0.5, phase_deg=90)})
            >>> f"largest {field.peak.max():.0f} m/s², {len(field.nulls)} nulls"
            'largest 113 m/s², 16 nulls'
        """
        points = None
        if raster is not None:
            such_as = "points along x and y such as (61, 46)"
            points = as_pair(raster, what="raster", such_as=such_as)
        excitations = []
        for layer in playable_layers(drive, self.rig):
            excitations += [self._played(excitation) for excitation in layer.excitations]
        return plate_map(self._real, *excitations, raster=points, free=self._free)

    def _played(self, excitation: Mapping[str, Tone]) -> dict[str, Tone]:
        """Return an excitation as this plate's channels play it."""
        names = [era.name for era in self.rig.eras]
        factors = dict(zip(names, self._drawn.factors(self.rig).tolist(), strict=True))
        tones = {}
        for name, tone in excitation.items():
            tones[name] = Tone.from_phasor(tone.frequency, factors[name] * tone.phasor)
        return tones

    def play(
        self,
        drive: Played | FloatArray,
        target: Positions | None = None,
        *,
        quiet: Positions = (),
        loads: Sequence[float] = (),
        duration: float | None = None,
        sample_rate: float | None = None,
    ) -> PlatePlayback:
        """Compute the vibration that fingers feel for a duration [s], starting at rest; default:
        until steady.

        - target: positions [m] of the fingers that should feel the whole drive; default: the
          fingers of an answer, each with its own layer and load.
        - loads: relative to the rig's fingertip, targets first; default 1.
        - sample_rate [Hz]: if given, drive is an array (ERAs, samples) of band-limited signals (1 =
          full stroke), which determines the duration and the sampling of the records.

        A layer of an answer starts with its onset or its ramp; any other drive starts with a 40 ms
        ramp. The plate is solved exactly in time, without time steps
        (`docs/concepts/plate-model.md`). Raises InputError for fingers off the plate, a duration in
        which the slowest vibration does not decay to 5 %, and drives that an ERA cannot play.

        Example:
            >>> felt = plate.play({"SW": 110}, target=(0.08, 0.06), quiet=(0.22, 0.16))
            >>> f"{felt.contrast_db:.0f} dB"
            '-4 dB'
        """
        if duration is not None:
            expect_number(duration, what="duration", unit="seconds")
        quiet_positions = as_points(quiet, what="quiet")
        finger_loads = as_loads(loads)
        targets = None if target is None else as_points(target, what="target")
        if targets is not None:
            fingers = together(Placement(targets, quiet_positions, finger_loads), Stimulus())
        elif isinstance(drive, Answer) and not quiet_positions and not finger_loads:
            fingers = [*drive.asked]
        else:
            raise InputError(
                "target must be positions of fingers such as (0.08, 0.06), got None; only an "
                "answer has fingers of its own"
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
        layers = playable_layers(drive, self.rig)
        if targets is not None:
            numbers = tuple(range(len(targets)))
            layers = tuple([replace(layer, fingers=numbers) for layer in layers])
        return play(
            self.rig,
            self._reduced,
            layers,
            fingers,
            duration=duration,
            imperfections=self._drawn,
        )

    @cached_property
    def _free(self) -> FreePlate:
        rig = self._real
        return solve_free_plate(rig.plate, rig.mesh, frequency_max=rig.limits.frequency_max)

    @cached_property
    def _reduced(self) -> ReducedPlate:
        attached = footprints_of(self._real.eras, self._real.masses)
        return reduce_free_plate(self._free, attached)


def draw_map(plate: SolvedPlate, drive: Played, *, title: str = "") -> "Figure":
    """Draw the peak acceleration over the plate in g (1 g = 9.8 m/s²), with ERAs and nulls
    (white lines).

    Same picture as `era plate map`. Raises InputError for a drive that the rig cannot play.

    Example:
        >>> era.draw_map(plate, {"SW": 110}).savefig("map.png")
    """
    from model.figures.plate_maps import map_figure

    expect_instance(plate, SolvedPlate, what="plate", made_by="era.SolvedPlate(rig)")
    layers = playable_layers(drive, plate.rig)
    active: set[str] = set()
    for layer in layers:
        active.update(*layer.excitations)
    return map_figure(plate.rig, plate.map(drive), active=active, title=title)


def draw_answer(table: LocalizationTable, answer: Answer, *, layer: int = 0) -> "Figure":
    """Draw an answer layer's level over the plate [dB SL], and the fingers.

    Raises InputError for a missing layer.

    Example:
        >>> era.draw_answer(table, only).savefig("answer.png")
    """
    from model.figures.answers import layer_figure

    expect_instance(table, LocalizationTable, what="table", made_by="era.table(rig)")
    expect_instance(answer, Answer, what="answer", made_by="era.query(table, target)")
    if not is_whole(layer) or not 0 <= layer < len(answer.layers):
        raise InputError(
            f"layer must be a number from 0 to {len(answer.layers) - 1}, got {shown(layer)}"
        )
    return layer_figure(table, answer, layer)


def draw_contents(table: LocalizationTable, answer: Answer) -> "Figure":
    """Draw all layers of an answer over the plate, each in its color; mixtures are gray.

    Each finger has its frequency, verdict, promised level and contrast next to it. Each layer is
    also drawn alone. Same picture as `era demo`. Raises InputError for an answer without layers.

    Example:
        >>> era.draw_contents(table, both).savefig("contents.png")
    """
    from model.figures.contents import contents_figure

    expect_instance(table, LocalizationTable, what="table", made_by="era.table(rig)")
    expect_instance(answer, Answer, what="answer", made_by="era.answer(table, fingers)")
    if not answer.layers:
        raise InputError("an answer must have a layer to be drawn, got one with quiet fingers only")
    return contents_figure(table, answer.layers, answer.promised_fingers, are_promised=True)


def draw_contrast_map(table: LocalizationTable, found: ContrastMap) -> "Figure":
    """Draw the promised contrast between every position and the quiet fingers, with drive modes
    side by side.

    Same picture as `era table map`.

    Example:
        >>> era.draw_contrast_map(table, found).savefig("contrast.png")
    """
    from model.figures.table_pictures import contrast_map_figure

    expect_instance(table, LocalizationTable, what="table", made_by="era.table(rig)")
    expect_instance(found, ContrastMap, what="found", made_by="era.contrast_map(table, quiet)")
    return contrast_map_figure(table, found)


def draw_playback(playback: PlatePlayback) -> "Figure":
    """Draw the acceleration at each finger over time [m/s²], on a logarithmic scale.

    Each curve shows the peak within a period of the lowest frequency (within 30 ms for signals). As
    in the definition of contrast, it is the mean over the fingertip at a target, and the loudest
    point at a quiet finger.

    Example:
        >>> era.draw_playback(plate.play(only)).savefig("playback.png")
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullLocator

    expect_instance(playback, PlatePlayback, what="playback", made_by="plate.play(pattern, target)")
    figure = Figure(figsize=(6.4, 3.8), layout="constrained")
    axes = figure.subplots()
    period = 1 / min(playback.frequencies, default=1 / LEVEL_WINDOW)
    for number, record in enumerate(playback.targets, start=1):
        times, peaks = _peaks(record, period)
        axes.plot(1000 * times, peaks @ record.weights, label=f"target {number}", lw=2)
    for number, record in enumerate(playback.quiet, start=1):
        times, peaks = _peaks(record, period)
        axes.plot(1000 * times, peaks.max(axis=1), label=f"quiet {number}", lw=1.2, ls="--")
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_xlabel("time / ms")
    axes.set_ylabel("peak acceleration / m/s²")
    axes.grid(True, which="both", alpha=0.2)
    axes.legend(loc="lower right")
    if playback.contrast_db is not None:
        transient, title = playback.transient_contrast_db, f"contrast {playback.contrast_db:.1f} dB"
        if transient is not None:
            title += f" steady, {transient:.1f} dB over the first 100 ms"
        axes.set_title(title, fontsize=11)
    return figure


def _peaks(record: FingerRecord, period: float) -> tuple[FloatArray, FloatArray]:
    """Return times (n,) [s] and peak accelerations (n, p) [m/s²] over the preceding period."""
    step = record.times[1] - record.times[0]
    width = min(max(1, round(period / step)), len(record.times))
    windows = sliding_window_view(np.abs(record.accelerations), width, axis=0)
    return record.times[width - 1 :], windows.max(axis=-1)
