"""Simulate in time how every region of a surface layout feels on a table's plate."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from controller.effects.effect import ON_RELEASE, Effect, EffectStimulus, Region
from controller.effects.layout import ELSEWHERE, SurfaceLayout
from controller.effects.player import CLICK_ABOVE_DB, NOTICED_ABOVE_DB
from controller.play.chooser import Chooser
from controller.play.intent import FingerTarget, Target, band_problem
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
from model.processes import Progress, unseen
from model.structure.attachments import fingertip_loads
from model.structure.plate import Plate
from model.table.table import LocalizationTable
from model.transients.base_motion import Bases, ramped_pulse
from model.transients.shaping import SAMPLE_RATE, Transients
from model.transients.time_response import PlateInTime, plate_in_time
from model.vibration import base_amplitudes

STEADY_AFTER, STEADY_FOR = 0.3, 0.1
"""Start and length [s] of the interval over which a continuous vibration is evaluated."""

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
        finger = Contact(target.key, *at, since=0.0)
        others = [
            Contact(ContactKey("quiet", number), *place, since=0.0)
            for number, place in enumerate(quiet)
        ]
        question = Question((finger, *others), (FingerTarget(finger, target),), ())
        return answered(self.table, question, question.lasting, self.capabilities)

    def touch(self, target: Target, at: Point, resting: Point | None) -> SimulatedTouch:
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


_REPORT = 0.01  # s, interval of the panel's reports
_WATCHED = 3.0  # s; simulated length of an effect that changes with time
_MAX_STEPS = 2000
_WAY = 0.12  # m
_SPEEDS = (0.05, 0.2, 1.0, 5.0)  # m/s
_TURNING_RADIUS = 0.02  # m

_KEY = ContactKey("check", 1)


def strongest_target(
    layout: SurfaceLayout, name: str, region: Region | None, *, at: tuple[float, float]
) -> Target | None:
    """Return the strongest target of an effect in a region, or outside all regions; None for none.

    at [m]: where the finger lands. A finger of a motion effect is moved along x, along y and around
    `at`.
    """
    effect, level = layout.effects[name], layout.level_of(name, region)
    watch = _while_moving if effect.is_for_motion else _while_resting
    strongest = max(watch(effect, region, level, at), key=_strength, default=None)
    if strongest is None:
        return None
    priority = 0 if region is None else region.priority
    band = layout.effects[name].band_in(region)
    return strongest.target(_KEY, name, region, band=band, priority=priority)


def _strength(stimulus: EffectStimulus) -> float:
    return math.inf if stimulus.level_db_sl is None else stimulus.level_db_sl


def _while_resting(
    effect: Effect, region: Region | None, level: float | None, at: tuple[float, float]
) -> Iterator[EffectStimulus]:
    contact = _finger(at)
    run = effect.start_in(region, contact, 0.0, level_db_sl=level)
    now: float | None = 0.0
    for _ in range(_MAX_STEPS):
        if now is None or now > _WATCHED:
            return
        felt = run.feel(contact, now)
        if felt is None:
            return
        if isinstance(felt, EffectStimulus):
            yield felt
        now = None if felt.until is None else max(felt.until, now + 1e-6)


def _while_moving(
    effect: Effect, region: Region | None, level: float | None, at: tuple[float, float]
) -> Iterator[EffectStimulus]:
    for speed in _SPEEDS:
        for along in ((1.0, 0.0), (0.0, 1.0), None):
            count = max(2, math.ceil(_WAY / speed / _REPORT)) + 8
            way = [_along(at, along, step * speed * _REPORT) for step in range(count)]
            run = effect.start_in(region, _finger(way[0]), 0.0, level_db_sl=level)
            for step, position in enumerate(way):
                felt = run.feel(_finger(position), step * _REPORT)
                if isinstance(felt, EffectStimulus):
                    yield felt


def _along(
    at: tuple[float, float], direction: tuple[float, float] | None, distance: float
) -> tuple[float, float]:
    """Return the position [m] after a distance [m] in a direction, or around a circle for None."""
    if direction is not None:
        return (at[0] + distance * direction[0], at[1] + distance * direction[1])
    angle = distance / _TURNING_RADIUS
    return (
        at[0] + _TURNING_RADIUS * math.cos(angle),
        at[1] + _TURNING_RADIUS * math.sin(angle),
    )


def _finger(at: tuple[float, float]) -> Contact:
    return Contact(_KEY, *at, since=0.0)


LEVEL_TOLERANCE, MARGIN_TOLERANCE = 2.0, 4.0
"""Tolerances of a level [dB]: below or above the promised one, and above one promised on 90 % of
plates."""

_ALIKE = 1.25  # ratio of frequencies that feel nearly alike

MAX_REGION_TOUCHES, MAX_POSITIONS = 30, 120  # in one region, in all
_MIN_STEP = 0.008  # m; closer touches hardly differ
_RESTING_AWAY = 0.06  # m, minimum distance from a touch to the resting finger


@dataclass(frozen=True)
class CheckedEffect:
    """Simulated touches of an effect in a region.

    on: layout key that plays the effect; promised_db_sl: None for as strong as the neighbors
    allow; touches: at each position alone, then with a resting finger; area [m²]: share of the
    region for each position.
    """

    region: str
    effect: str
    on: str
    promised_db_sl: float | None
    touches: tuple[SimulatedTouch, ...]
    problems: tuple[str, ...]

    @property
    def felt(self) -> list[float]:
        """Levels [dB SL] of all touches that are felt, over the effect."""
        return [each.felt_db_sl for each in self.touches if each.felt_db_sl is not None]

    @property
    def contrasts(self) -> list[float]:
        """Contrast with the resting finger on the nominal plate [dB]."""
        return [
            each.felt_db_sl - each.resting_db_sl
            for each in self.touches
            if each.felt_db_sl is not None and each.resting_db_sl is not None
        ]

    @property
    def promised_contrasts(self) -> list[float]:
        """Contrast with the resting finger on 90 % of plates [dB]."""
        found = [each.promised_contrast_db for each in self.touches]
        return [each for each in found if each is not None]

    @property
    def held_back_db(self) -> float:
        """Largest reduction of a touch [dB] for the resting finger's sake."""
        return max((each.held_back_db for each in self.touches), default=0.0)

    @property
    def exposure_m_s2(self) -> float:
        """Highest weighted RMS acceleration of a touch [m/s²] (`exposures`)."""
        return max((each.exposure_m_s2 for each in self.touches), default=0.0)

    @property
    def frequencies(self) -> list[float]:
        """All frequencies played [Hz], ascending."""
        return sorted({frequency for each in self.touches for frequency in each.frequencies})

    def as_json(self) -> dict[str, Any]:
        """Return the JSON object of `era layout check --json`."""
        return {
            "region": self.region,
            "effect": self.effect,
            "on": self.on,
            "promised_db_sl": self.promised_db_sl,
            "felt_db_sl": distribution(self.felt),
            "promised_contrast_db": distribution(self.promised_contrasts),
            "felt_contrast_db": distribution(self.contrasts),
            "held_back_db": self.held_back_db,
            "exposure_m_s2": self.exposure_m_s2,
            "frequency_hz": self.frequencies,
            "touches": len(self.touches),
            "problems": [*self.problems],
        }


def distribution(values: Sequence[float]) -> dict[str, float | None]:
    """Return minimum, median and maximum; None without values."""
    if not values:
        return {"min": None, "median": None, "max": None}
    return {
        "min": float(min(values)),
        "median": float(np.median(values)),
        "max": float(max(values)),
    }


def check_layout(
    layout: SurfaceLayout,
    table: LocalizationTable,
    *,
    progress: Progress = unseen,
) -> list[CheckedEffect]:
    """Simulate touches over every region of a layout, alone and with a resting second finger.

    progress: called with the number of effects checked and the total.
    """
    simulator = TouchSimulator(table)
    parts = [*layout.uses()]
    checked = []
    count = max(1, min(MAX_REGION_TOUCHES, MAX_POSITIONS // max(1, len(parts))))
    for number, (region, on, name) in enumerate(parts):
        progress(number, len(parts))
        checked.append(_check(layout, region, on, name, table, simulator, count))
    progress(len(parts), len(parts))
    return checked


def _check(
    layout: SurfaceLayout,
    region: Region | None,
    on: str,
    name: str,
    table: LocalizationTable,
    simulator: TouchSimulator,
    count: int,
) -> CheckedEffect:
    places, area = touch_positions(layout, region, table.plate, count)
    start = region.shape.centre if region is not None else (places[0] if places else (0.0, 0.0))
    target = strongest_target(layout, name, region, at=start)
    called = ELSEWHERE if region is None else region.name
    if target is None or not places:
        why = "is felt nowhere" if target is None else "is covered by later regions"
        level = layout.level_of(name, region)
        return CheckedEffect(called, name, on, level, (), (f"{name} {why}",))
    is_fixed = target.band is not None or (target.pulse is not None and target.pulse.is_raised)
    touches = [
        simulator.touch(target, at, resting)
        for number, at in enumerate(places)
        for resting in (None, _resting(table.plate, at, number))
    ]
    problems = [
        *_silent(target, touches, area),
        *_off_level(target.level_db_sl, touches, area, has_margin=not is_fixed),
        *_unnoticed(layout, region, on, name, target, at=start),
        *_off_band(target.band, table, touches, must_be_alike=layout.effects[name].is_for_motion),
    ]
    return CheckedEffect(called, name, on, target.level_db_sl, tuple(touches), tuple(problems))


def touch_positions(
    layout: SurfaceLayout, region: Region | None, plate: Plate, count: int = MAX_REGION_TOUCHES
) -> tuple[list[Point], float]:
    """Return up to `count` positions [m], evenly spaced over a region, and the area of each [m²].

    Excludes parts that later regions cover.
    """
    corners = [(0.0, 0.0), (plate.length, plate.width)]
    if region is not None:
        corners = [*region.shape.corners()]
    (x0, y0), (x1, y1) = np.min(corners, axis=0), np.max(corners, axis=0)
    step = _MIN_STEP
    while True:
        nx, ny = (max(1, math.floor(size / step + 1e-9)) for size in (x1 - x0, y1 - y0))
        dx, dy = (x1 - x0) / nx, (y1 - y0) / ny
        places = [
            (float(x0 + (column + 0.5) * dx), float(y0 + (row + 0.5) * dy))
            for row in range(ny)
            for column in range(nx)
        ]
        found = [at for at in places if layout.region_at(*at) is region]
        if len(found) <= count:
            return found, dx * dy
        step *= 1.1


def _resting(plate: Plate, at: Point, number: int) -> Point:
    """Return the position of the second finger: in another quarter of the plate each time."""
    quarters = [(x * plate.length, y * plate.width) for x in (0.25, 0.75) for y in (0.25, 0.75)]
    away = [each for each in quarters if math.dist(each, at) >= _RESTING_AWAY]
    if not away:
        return max(quarters, key=lambda each: math.dist(each, at))
    return away[number % len(away)]


def _silent(target: Target, touches: Sequence[SimulatedTouch], area: float) -> Iterator[str]:
    # The level that the neighbors allow can be zero.
    can_be = target.level_db_sl is None
    silent = [each for each in touches if each.reason is not None and not (can_be and each.resting)]
    if silent:
        yield f"nothing is felt {_where(silent, touches, area)}: {silent[0].reason}"


def _off_level(
    promised: float | None, touches: Sequence[SimulatedTouch], area: float, *, has_margin: bool
) -> Iterator[str]:
    if promised is None:
        return
    above = MARGIN_TOLERANCE if has_margin else LEVEL_TOLERANCE
    for sense, words, tolerance in ((-1, "below", LEVEL_TOLERANCE), (1, "above", above)):
        off = {
            each: sense * (each.felt_db_sl - promised)
            for each in touches
            if each.felt_db_sl is not None and sense * (each.felt_db_sl - promised) > tolerance
        }
        if off:
            yield (
                f"level is up to {max(off.values()):.1f} dB {words} {promised:g} dB SL "
                f"{_where([*off], touches, area)}"
            )


def _unnoticed(
    layout: SurfaceLayout,
    region: Region | None,
    on: str,
    name: str,
    click: Target,
    *,
    at: Point,
) -> Iterator[str]:
    """Yield short effects whose stated level is masked by a continuous effect of the region."""
    if on == ON_RELEASE or not click.is_short or not layout.effects[name].gives_level_in(region):
        return
    for other, beside, lasting in layout.uses():
        if other is not region or beside in (on, ON_RELEASE):
            continue
        felt = strongest_target(layout, lasting, region, at=at)
        if felt is None or felt.is_short or felt.level_db_sl is None or click.level_db_sl is None:
            continue
        if click.level_db_sl < felt.level_db_sl + NOTICED_ABOVE_DB:
            yield (
                f"level {click.level_db_sl:g} dB SL is less than {NOTICED_ABOVE_DB:g} dB above "
                f"{lasting}, {felt.level_db_sl:g} dB SL, and is hardly noticed; raise "
                f"it, or give {name} no level: it is then {CLICK_ABOVE_DB:g} dB above"
            )


def _off_band(
    band: tuple[float, float] | None,
    table: LocalizationTable,
    touches: Sequence[SimulatedTouch],
    *,
    must_be_alike: bool,
) -> Iterator[str]:
    played = sorted({frequency for each in touches for frequency in each.frequencies})
    if not played:
        return
    if band is None:
        if must_be_alike and played[-1] > _ALIKE * played[0]:
            yield (
                f"frequency is {played[0]:g} to {played[-1]:g} Hz, depending on position; give it "
                "a frequency or a band"
            )
        return
    problem = band_problem(band, table.frequencies)
    if problem is not None:
        yield problem


def _where(some: Sequence[SimulatedTouch], touches: Sequence[SimulatedTouch], area: float) -> str:
    """Format the part of a region, in percent and by position, in which something happens."""
    places = sorted({each.at for each in some})
    share = len(places) / len({each.at for each in touches})
    (x0, y0), (x1, y1) = np.min(places, axis=0), np.max(places, axis=0)
    second = "" if any(each.resting is None for each in some) else ", with a second finger"
    return (
        f"on {100 * share:.0f} % of the region ({1e4 * area * len(places):.1f} cm²), x {x0:.3f} to "
        f"{x1:.3f}, y {y0:.3f} to {y1:.3f} m{second}"
    )
