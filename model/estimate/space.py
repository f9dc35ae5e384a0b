"""Which parameters of a rig a fit may change: each kind in one table, and the spaces of them.

`KINDS` says of each kind what it is called, how well it is known beforehand, how it changes the rig
and how responses follow it. A space has those of a rig that is measured in place (`space_of`), or
of one that data sheets describe (`space_by_sheets`); `rig_with` writes what a fit found to a rig.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from model.arrays import ComplexArray, FloatArray, IntArray
from model.estimate.forward import (
    FINGER_PARTS,
    MASS_CELLS,
    MIN_LOSS_FACTOR,
    MODE_SHIFTS,
    Kind,
    Number,
    PlateAt,
    Range,
    SearchScope,
    Space,
    Values,
    values_of_eras,
)
from model.rig.rig import Rig, Uncertainty
from model.structure.attachments import FEET_DEVIATE, Gain, PointLoad, damping_from_ratio
from model.structure.plate import LOSS_FREQUENCY, MAX_LOSS_EXPONENT, MAX_LOSS_FACTOR, Plate

_BUILT = Uncertainty()
_DAMPED = math.log(_BUILT.damping)

UNIT_KEYS = {"%": "percent", "°": "deg", "/kHz²": "1/kHz^2", "/kHz": "1/kHz"}
"""Units in reports for programs, of those that people read in another way."""

FORM = ("sensor_scale", "sensor_place", "foreign_mass", "side", "poisson", "loss_law")
"""Kinds whose parameters only a plate with form errors has."""

COIL_DEVIATES = 0.2
"""Assumed standard deviation of the mass of an exciter's coil by its sheet, relative."""

MAX_GUESSED = math.sqrt(0.5)
"""Standard error of a parameter with a prior, in its deviations, beyond which the prior determines
it more than the data do."""

VALUE_UNITS = {
    "length": "m",
    "width": "m",
    "thickness": "m",
    "modulus": "Pa",
    "loss_factor": "",
    "stiffness": "N/m",
    "damping": "N s/m",
    "bolt_mass": "kg",
    "magnet_mass": "kg",
    "supports": "N/m",
}
"""Units of the values of a rig that parameters change."""

_AT_EDGE = 1e-6  # m
_MIN_MASS = 1e-5  # kg; a lighter one is not written to a rig
_GAIN_STEP = 10.0  # Hz, of a drive that lags; linear between them is right to a thousandth
_OWN_SHARE = 0.7  # least deviation by sheets of a loss, relative to the rig's


def _damps(scope: SearchScope) -> FloatArray:
    """Which ERAs have a damping that is not known (n,), 0 or 1."""
    damped = [float(era.damping > 0) for era in scope.rig.eras]
    return (scope.uncertainty.damping > 1) * np.array(damped)


def _loses(scope: SearchScope, std: float) -> float:
    """A deviation, 0 of a plate without losses or of known ones."""
    return std * float(scope.uncertainty.damping > 1 and scope.rig.plate.loss_factor > 0)


def _lags(scope: SearchScope, std: float) -> Number:
    """A deviation of the drives whose lag nothing states.

    A measured gain has the lag of its drive in it, and an exciter's force that of its coil.
    """
    known = [bool(era.gains) for era in scope.rig.eras] | scope.excites
    return std * (~known & scope.drives_lag)


def _of_form(scope: SearchScope, std: float) -> Range:
    """Deviations of a plate with form errors, 0 of one without."""
    return std * (scope.form_of is not None), -np.inf, np.inf


def _factors(scope: SearchScope, std: Number, largest: float) -> Range:
    """Range of logarithms of factors on values of parts as sold, of which a rig knows the error."""
    return np.maximum(std, scope.rig.uncertainty.stiffness), -largest, largest


def _added(value: Number, std: Number, largest: Number) -> Range:
    """Range of what is added to a value, which cannot become less than zero."""
    return std, -value, np.maximum(largest - value, value)


def _damping_by_sheets(scope: SearchScope, std: float) -> Range:
    """Range of what is added to the damping of each ERA, by a damping ratio."""
    rig, c = scope.rig, values_of_eras(scope.rig, "damping")
    unit = np.array(
        [
            damping_from_ratio(
                1.0,
                stiffness=era.in_time.stiffness,
                plate_mass=rig.plate.mass,
                era_count=len(rig.eras),
            )
            for era in rig.eras
        ]
    )
    return _added(c, np.maximum(_OWN_SHARE * c, std * unit), 2.0 * unit)


def _bolts_by_sheets(scope: SearchScope, std: float) -> Range:
    """Range of what is added to the mass of each bolt or coil.

    A coil weighs what its sheet says, but for glue; a response tells it together with a gain.
    """
    bolt, unit = values_of_eras(scope.rig, "bolt_mass"), scope.rig.plate.mass / len(scope.rig.eras)
    is_coil = scope.excites & (bolt > 0)
    largest = np.where(is_coil, 2 * bolt, 5.0 * unit)
    return _added(bolt, np.where(is_coil, COIL_DEVIATES * bolt, 0.05 * unit), largest)


def _by_lag(plate: PlateAt, factor: complex, power: int) -> ComplexArray:
    """Derivatives by what makes drives lag with a power of frequency."""
    f = 1e-3 * plate.model.frequencies[:, None]
    return plate.by_drives((factor * f**power * plate.lag)[:, None, None])


def _finger_numbers(plate: PlateAt) -> IntArray:
    """Number among the attachments of the finger of each parameter (4 k,)."""
    before = len(plate.sources) + len(plate.model.rig.masses) + plate.model.mass_count
    return np.repeat(before + np.arange(len(plate.finger_slopes)), len(FINGER_PARTS))


def _if_form(scope: SearchScope, names: Sequence[str]) -> Sequence[str]:
    """Names of parameters that only a plate with form errors has."""
    return names if scope.form_of is not None else ()


def _on_plate(values: Values) -> FloatArray:
    """Additional masses [kg] with x and y [m] (m, 3), which stay on the plate."""
    masses = values.own("masses").reshape(-1, 3)
    sides = np.array([values.rig.plate.length, values.rig.plate.width])
    masses[:, 1:] = np.clip(masses[:, 1:] + sides / 2, 0, sides)
    return masses


def _scaled(values: Values, key: str) -> FloatArray:
    """Values of all ERAs by their key, times the factors of the kind of that name (n,)."""
    return values_of_eras(values.rig, key) * np.exp(values.own(key))


def _of_exciters(key: str, *, largest: float, drift: float = 0.0) -> Kind:
    """The kind of factors on a value of exciters, which other ERAs do not have."""

    def by_sheet(scope: SearchScope, std: float) -> Range:
        of_all, low, high = _factors(scope, std, largest)
        return of_all * scope.excites, low, high

    return Kind(
        _BUILT.stiffness,
        names=lambda scope: [
            f"{key.replace('_', ' ')} {name}" for name in scope.eras if scope.excites.any()
        ],
        slope=lambda plate: plate.by_sources(key),
        value=lambda values: _scaled(values, key),
        stated=lambda scope, std: scope.uncertainty.stiffness * scope.excites,
        by_sheet=by_sheet,
        drift=drift,
    )


KINDS: dict[str, Kind] = {
    "thickness": Kind(
        _BUILT.thickness,
        names=lambda scope: ["thickness"],
        slope=lambda plate: (
            2 * plate.by_log_rigidity
            - plate.responding(plate.by_free(plate.free_receptance))[..., None]
        ),
        value=lambda values: float(np.exp(values.own("thickness")[0])),
        stated=lambda scope, std: scope.uncertainty.thickness,
        drift=0.01,
        stage=0,
        is_listed=True,
    ),
    # Known where the thickness is.
    "modulus": Kind(
        _BUILT.modulus,
        names=lambda scope: ["modulus"],
        slope=lambda plate: plate.by_log_rigidity,
        value=lambda values: float(np.exp(values.own("modulus")[0])),
        stated=lambda scope, std: max(
            std * (scope.uncertainty.thickness > 0), scope.uncertainty.elasticity
        ),
        by_sheet=lambda scope, std: (0.07, -math.log(3.0), math.log(3.0)),
        is_listed=True,
    ),
    "stiffness": Kind(
        _BUILT.stiffness,
        names=lambda scope: [f"stiffness {name}" for name in scope.eras],
        slope=lambda plate: plate.by_sources("stiffness"),
        value=lambda values: _scaled(values, "stiffness"),
        stated=lambda scope, std: scope.uncertainty.stiffness,
        by_sheet=lambda scope, std: _factors(scope, 0.10, math.log(10.0)),
        drift=0.03,
        theory=3e-3,
        stage=0,
        is_listed=True,
    ),
    # Of all ERAs; the damping of one is known where this is.
    "damping": Kind(
        _DAMPED,
        names=lambda scope: ["damping"],
        slope=lambda plate: KINDS["damping_each"].slope(plate).sum(axis=-1, keepdims=True),
        value=lambda values: np.maximum(
            values_of_eras(values.rig, "damping")
            * np.exp(values.own("damping") + values.own("damping_each"))
            + values.own("damping_added"),
            0.0,
        ),
        stated=lambda scope, std: math.log(scope.uncertainty.damping) * _damps(scope).max(),
        stage=0,
        is_listed=True,
    ),
    "damping_each": Kind(
        0.2,
        names=lambda scope: [f"damping {name}" for name in scope.eras],
        slope=lambda plate: plate.by_sources("damping") * plate.values["damping"],
        stated=lambda scope, std: std * _damps(scope),
        drift=0.07,
        drifts_to=_DAMPED,
        theory=0.01,
        stage=0,
    ),
    # Beside that of the rig, which may have none; data sheets give little, of ERAs by their ratio.
    "damping_added": Kind(
        0.0,
        names=lambda scope: [f"further damping {name}" for name in scope.eras],
        slope=lambda plate: plate.by_sources("damping"),
        by_sheet=_damping_by_sheets,
        unit="N s/m",
        per_unit=1.0,
    ),
    "loss": Kind(
        _DAMPED,
        names=lambda scope: ["loss factor"],
        slope=lambda plate: plate.by_log_loss,
        value=lambda values: float(
            np.clip(
                values.rig.plate.loss_factor * np.exp(values.own("loss")[0])
                + values.own("loss_added")[0],
                0.0,
                MAX_LOSS_FACTOR,
            )
        ),
        stated=lambda scope, std: _loses(scope, math.log(scope.uncertainty.damping)),
        drift=0.1,
        stage=0,
        is_listed=True,
    ),
    "loss_added": Kind(
        0.0,
        names=lambda scope: ["further loss factor"],
        slope=lambda plate: plate.by_log_loss / max(plate.values["loss"], MIN_LOSS_FACTOR),
        by_sheet=lambda scope, std: _added(
            scope.rig.plate.loss_factor, max(_OWN_SHARE * scope.rig.plate.loss_factor, 0.003), 0.5
        ),
        unit="",
        per_unit=1.0,
    ),
    # The power of frequency that the loss factor follows.
    "loss_exponent": Kind(
        0.3,
        names=lambda scope: ["loss exponent"],
        slope=lambda plate: (
            np.log(plate.model.frequencies / LOSS_FREQUENCY)[:, None, None, None]
            * plate.by_log_loss
        ),
        value=lambda values: float(values.rig.plate.loss_exponent + values.own("loss_exponent")[0]),
        stated=_loses,
        limits=lambda scope: (
            -MAX_LOSS_EXPONENT - scope.rig.plate.loss_exponent,
            MAX_LOSS_EXPONENT - scope.rig.plate.loss_exponent,
        ),
        unit="",
        per_unit=1.0,
    ),
    # Of a drive, complex with its phase, beside that of the rig.
    "gain": Kind(
        _BUILT.gain,
        names=lambda scope: [f"gain {name}" for name in scope.eras],
        slope=lambda plate: plate.by_drives(),
        value=lambda values: np.exp(values.own("gain") + 1j * values.own("phase")),
        stated=lambda scope, std: scope.uncertainty.gain,
        by_sheet=lambda scope, std: (1.0, -8.0, 8.0),
        drift=0.01,
        stage=0,
        is_listed=True,
    ),
    "phase": Kind(
        math.radians(_BUILT.phase_deg),
        names=lambda scope: [f"phase {name}" for name in scope.eras],
        slope=lambda plate: plate.by_drives(1j),
        stated=lambda scope, std: math.radians(scope.uncertainty.phase_deg),
        unit="°",
        per_unit=math.degrees(1),
        drift=math.radians(1),
        stage=0,
        is_listed=True,
    ),
    # A resonance at 700 Hz with a damping ratio of 0.5.
    "inertia": Kind(
        1 / 0.7**2,
        names=lambda scope: [f"inertia of drive {name}" for name in scope.eras],
        slope=lambda plate: _by_lag(plate, 1.0, 2),
        stated=_lags,
        limits=lambda scope: (0.0, np.inf),
        unit="/kHz²",
        per_unit=1.0,
        stage=0,
    ),
    "drag": Kind(
        1 / 0.7,
        names=lambda scope: [f"drag of drive {name}" for name in scope.eras],
        slope=lambda plate: _by_lag(plate, -1j, 1),
        stated=_lags,
        limits=lambda scope: (0.0, np.inf),
        unit="/kHz",
        per_unit=1.0,
        stage=0,
    ),
    # Of an amplifier's clock: what no exchange over unlike lines shows. Only differences count:
    # those to the first.
    "delay": Kind(
        200e-6,
        names=lambda scope: [f"delay of amplifier {name}" for name in scope.amplifiers],
        slope=lambda plate: (
            -1j
            * plate.model.omega[:, None, None, None]
            * plate.responses[..., None]
            * plate.model.lateness
        ),
        stated=lambda scope, std: np.where(np.arange(len(scope.amplifiers)) > 0, std, 0.0),
        unit="us",
        per_unit=1e6,
        stage=0,
    ),
    # Complex with its phase.
    "sensor_gain": Kind(
        0.05,
        names=lambda scope: [f"gain of sensor {name}" for name in scope.sensors],
        slope=lambda plate: plate.by_sensors,
        value=lambda values: np.exp(values.own("sensor_gain") + 1j * values.own("sensor_phase")),
        stage=0,
    ),
    "sensor_phase": Kind(
        math.radians(5),
        names=lambda scope: [f"phase of sensor {name}" for name in scope.sensors],
        slope=lambda plate: 1j * plate.by_sensors,
        unit="°",
        per_unit=math.degrees(1),
        stage=0,
    ),
    # Of an exciter its coil. By data sheets: of the plate's mass that an ERA carries.
    "bolt_mass": Kind(
        0.5e-3,
        names=lambda scope: [f"bolt mass {name}" for name in scope.eras],
        slope=lambda plate: plate.by_sources("bolt_mass"),
        value=lambda values: np.maximum(
            values_of_eras(values.rig, "bolt_mass") + values.own("bolt_mass"), 0.0
        ),
        limits=lambda scope: (-values_of_eras(scope.rig, "bolt_mass"), np.inf),
        by_sheet=_bolts_by_sheets,
        unit="g",
        per_unit=1e3,
    ),
    "magnet_mass": _of_exciters("magnet_mass", largest=math.log(10.0)),
    # It damps as the suspension of its exciter does, and no response tells them apart.
    "force_factor": _of_exciters("force_factor", largest=math.inf, drift=0.01),
    # Of an ERA, on each axis. With form errors it may leave the plate, whose shapes go on by their
    # slopes.
    "place": Kind(
        1.5e-3,
        names=lambda scope: [f"{axis} of {name}" for name in scope.eras for axis in "xy"],
        slope=lambda plate: plate.by_places[..., : 2 * len(plate.sources)],
        value=lambda values: (
            np.array([(era.x, era.y) for era in values.rig.eras])
            + values.own("place").reshape(-1, 2)
        ),
        limits=lambda scope: (
            -np.ravel([(era.x, era.y) for era in scope.rig.eras]),
            np.ravel(scope.sides - [(era.x, era.y) for era in scope.rig.eras]),
        ),
        by_sheet=_of_form,
        unit="mm",
        per_unit=1e3,
        theory=1e-4,
        stage=1,
    ),
    # Additional masses with their places, about the middle of the plate.
    "masses": Kind(
        2e-3,
        names=lambda scope: [
            f"{of}mass {n}" for n in range(1, scope.masses + 1) for of in ("", "x of ", "y of ")
        ],
        slope=lambda plate: plate.by_masses(),
        value=_on_plate,
        stated=lambda scope, std: np.tile([std, *scope.sides / 3], scope.masses),
        limits=lambda scope: (
            np.tile([0.0, *-scope.sides / 2], scope.masses),
            np.tile([np.inf, *scope.sides / 2], scope.masses),
        ),
        unit="g",
        per_unit=1e3,
        stage=1,
    ),
    # Logarithms of factors on the eigenvalues and loss factors of the lowest modes.
    "mode_shifts": Kind(
        0.01,
        names=lambda scope: [f"stiffness of mode {n}" for n in range(1, scope.mode_count + 1)],
        slope=lambda plate: plate.by_modes(1.0),
        by_sheet=lambda scope, std: (0.003, -np.inf, np.inf),
        theory=3e-3,
    ),
    "mode_losses": Kind(
        0.5,
        names=lambda scope: [f"loss of mode {n}" for n in range(1, scope.mode_count + 1)],
        slope=lambda plate: plate.by_modes(plate.by_mode_loss),
        stated=_loses,
    ),
    # Factors on the stiffness of each foot.
    "supports": Kind(
        FEET_DEVIATE,
        names=lambda scope: [f"stiffness of foot {name}" for name in scope.rig.foot_names],
        slope=lambda plate: plate.by_stiffness(
            len(plate.sources) + np.array(plate.model.rig.feet, dtype=int),
            plate.values["supports"] * plate.model.springs,
        ),
        value=lambda values: np.exp(values.own("supports")),
        stated=lambda scope, std: scope.uncertainty.supports,
        by_sheet=lambda scope, std: (
            scope.rig.uncertainty.supports,
            -math.log(10.0),
            math.log(10.0),
        ),
        is_listed=True,
    ),
    # Of each of FINGER_PARTS of a finger, which the daemon adds.
    "fingers": Kind(
        0.5,
        names=lambda scope: [],
        slope=lambda plate: plate.by_stiffness(
            _finger_numbers(plate),
            np.concatenate(plate.finger_slopes, axis=1),
        ),
        value=lambda values: values.own("fingers").reshape(-1, 4),
    ),
    # Form errors: a ruler's, a cutter's, and 1 % of the plate's mass over all cells, as its shares.
    "sensor_scale": Kind(
        0.01,
        names=lambda scope: _if_form(scope, [f"scale of sensor {name}" for name in scope.sensors]),
        slope=lambda plate: (
            (plate.values["sensor_gain"][:, None] * plate.drive[:, None] * plate.late * plate.seen)[
                ..., None
            ]
            * np.eye(len(plate.model.sensors))[:, None]
        ),
        value=lambda values: (
            1 + values.own("sensor_scale") if values.own("sensor_scale").size else 1.0
        ),
        by_sheet=_of_form,
    ),
    "sensor_place": Kind(
        0.5e-3,
        names=lambda scope: [
            f"{axis} of sensor {n}" for n in range(scope.form_of or 0) for axis in "xy"
        ],
        slope=lambda plate: plate.by_places[
            ..., 2 * (len(plate.sources) + plate.model.mass_count) :
        ],
        value=lambda values: values.own("sensor_place").reshape(-1, 2),
        by_sheet=_of_form,
        unit="mm",
        per_unit=1e3,
    ),
    # Its sum over all cells is zero.
    "foreign_mass": Kind(
        0.01 / math.sqrt(MASS_CELLS.cell_count),
        names=lambda scope: _if_form(scope, [f"mass {n}" for n in range(MASS_CELLS.cell_count)]),
        slope=lambda plate: plate.by_foreign_mass(),
        value=lambda values: values.own("foreign_mass") - values.own("foreign_mass").mean(),
        by_sheet=_of_form,
    ),
    "side": Kind(
        0.5e-3,
        names=lambda scope: _if_form(scope, ["length", "width"]),
        slope=lambda plate: plate.by_stretch(0, 1) / plate.model.sides,
        value=lambda values: values.own("side") / [values.rig.plate.length, values.rig.plate.width],
        by_sheet=_of_form,
        unit="mm",
        per_unit=1e3,
    ),
    "poisson": Kind(
        0.015,
        names=lambda scope: _if_form(scope, ["Poisson's ratio"]),
        slope=lambda plate: plate.by_stretch(2),
        by_sheet=_of_form,
        unit="",
        per_unit=1.0,
    ),
    # From hysteretic losses, 0, to viscous ones, 1 (`model.estimate.forward`).
    "loss_law": Kind(
        1.0,
        names=lambda scope: _if_form(scope, ["loss law"]),
        slope=lambda plate: (plate.scale * (0.0 if plate.model.law is None else plate.model.law))[
            ..., None
        ],
        value=lambda values: float(values.own("loss_law").sum()),
        by_sheet=_of_form,
        unit="",
        per_unit=1.0,
    ),
}
"""All kinds of parameters by their names, in the order of a space.

`theory` is that of plates of 1.5 mm without shear deformation, with viscous losses
(docs/measured/identification.md). No measurement shows it, and answers do not depend on it.
"""


def space_of(
    rig: Rig,
    sensors: Sequence[str],
    uncertainty: Uncertainty,
    *,
    drives_lag: bool = False,
    amplifiers: Sequence[str] = (),
    masses: int = 0,
    mode_count: int = MODE_SHIFTS,
) -> Space:
    """Parameters of a rig that is measured in place, as `SearchScope` has it.

    Its `common_gain` is no parameter: sensors may be those that it was found by, and tell nothing
    more of it.
    """

    def known(kind: Kind) -> Range:
        std = kind.std if kind.stated is None else kind.stated(scope, kind.std)
        return std, *((-np.inf, np.inf) if kind.limits is None else kind.limits(scope))

    scope = SearchScope(rig, sensors, uncertainty, drives_lag, amplifiers, masses, mode_count)
    return _space(scope, known)


def space_by_sheets(rig: Rig, sensors: Sequence[str], form_modes: int | None) -> Space:
    """Parameters of a rig of data sheets: its plate's modulus and losses, its ERAs and their gains.

    form_modes: also form errors, with so many modes that shift; None for none. All else is known.
    """
    form_of = None if form_modes is None else len(sensors)
    scope = SearchScope(
        rig, sensors, Uncertainty.none(), mode_count=form_modes or 0, form_of=form_of
    )
    return _space(
        scope,
        lambda kind: kind.by_sheet(scope, kind.std) if kind.by_sheet else (0.0, -np.inf, np.inf),
    )


def _space(scope: SearchScope, known: Callable[[Kind], Range]) -> Space:
    """All parameters of a scope, whose ranges follow from their kind."""
    none = np.zeros(0)
    space = Space((), none, none, none, {}, KINDS)
    for name, kind in KINDS.items():
        names = kind.names(scope)
        space = space.and_further(name, names, known(kind) if names else None)
    return space


def inwards(space: Space, x: FloatArray, *, by: float) -> FloatArray:
    """Move the places of x (p,) that are on an edge inwards, by so many standard deviations.

    There a place cannot go the other way, and half of a start's surroundings would be lost.
    """
    moved = x.copy()
    for number in space.indices("place"):
        if space.std[number] * (x[number] - space.lower[number]) < _AT_EDGE:
            moved[number] += by
        elif space.std[number] * (space.upper[number] - x[number]) < _AT_EDGE:
            moved[number] -= by
    return np.where(space.uncertain, moved, x)


def rig_with(rig: Rig, values: Values, uncertainty: Uncertainty) -> Rig:
    """The rig with identified values; additional masses come after its own."""
    places = np.clip(values["place"], 0, [rig.plate.length, rig.plate.width])
    eras = tuple(
        replace(
            era,
            x=float(places[number, 0]),
            y=float(places[number, 1]),
            gains=_gains(rig, values, number),
        )
        for number, era in enumerate(values.sources())
    )
    masses = list(rig.masses)
    for foot, factor in zip(rig.feet, values["supports"].tolist(), strict=True):
        masses[foot] = replace(masses[foot], stiffness=factor * masses[foot].stiffness)
    found = [each for each in values["masses"].tolist() if each[0] > _MIN_MASS]
    masses += [PointLoad(x, y, mass=mass) for mass, x, y in found]
    return replace(
        rig,
        plate=plate_with(rig.plate, values),
        laminate=rig.laminate
        and rig.laminate.scaled(modulus=values["modulus"], thickness=values["thickness"]),
        eras=eras,
        masses=tuple(masses),
        uncertainty=uncertainty,
    )


def plate_with(plate: Plate, values: Values) -> Plate:
    """The plate with identified thickness, modulus, losses and modes."""
    shifted = np.column_stack([values["mode_shifts"], values["mode_losses"]])
    count = max(len(plate.mode_deviations), len(shifted))
    deviations = np.zeros((count, 2))
    deviations[: len(plate.mode_deviations)] = np.reshape(plate.mode_deviations, (-1, 2))
    deviations[: len(shifted)] += shifted
    return replace(
        plate.scaled(modulus=values["modulus"], thickness=values["thickness"]),
        loss_factor=values["loss"],
        loss_exponent=values["loss_exponent"],
        mode_deviations=tuple((float(a), float(b)) for a, b in deviations if deviations.any()),
    )


def _gains(rig: Rig, values: Values, number: int) -> tuple[Gain, ...]:
    """Gains of an ERA: those of the rig times what was identified.

    An ERA without measured gains gets one at a single frequency, or some over the rig's frequencies
    where its drive or the clock of its amplifier lags.
    """
    era, gain = rig.eras[number], values["gain"][number]
    lags = values["inertia"][number] or values["drag"][number]
    names = sorted({channel.amplifier for channel in rig.wiring.values()})
    delays = dict(zip(names, values["delay"].tolist(), strict=False))  # none where clocks agree
    delay = delays.get(rig.wiring[era.name].amplifier, 0.0)
    if gain == 1 and not (lags or delay):
        return era.gains
    before = era.gains or ((LOSS_FREQUENCY, 1.0, 0.0),)
    if lags or (delay and not era.gains):
        low, high = rig.limits.frequency_min, rig.limits.frequency_max
        count = 1 + int(np.ceil((high - low) / _GAIN_STEP))
        before = tuple((float(f), 1.0, 0.0) for f in np.linspace(low, high, count))
    f = np.array([f for f, *_ in before])
    late = np.exp(-2j * np.pi * f * delay)
    factors = gain * values.lag(f)[:, number] * late
    return tuple(
        (f, magnitude * float(abs(factor)), turned + float(np.angle(factor)))
        for (f, magnitude, turned), factor in zip(before, factors.tolist(), strict=True)
    )
