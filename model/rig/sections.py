"""Sections of a rig file: the whole file, attachments, amplifiers, limits, and uncertainties.

`model.rig.plate_sections` has the sections of the plate, `model.rig.actuator_keys` the sections of
actuators. A section builds its part of a rig (`build`). Bounds are wide: they catch
values in the wrong unit.
"""

from dataclasses import replace
from typing import Annotated, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    Strict,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)

from model.config.fields import Quantity, Section
from model.config.units import (
    DAMPING,
    LENGTH,
    LINE_MASS,
    LINE_STIFFNESS,
    MASS,
    RATE,
    RATIO,
    SLEW,
    STIFFNESS,
    TIME,
    Dimension,
)
from model.errors import InputError
from model.finger import DEFAULT_THRESHOLD, PUBLISHED_THRESHOLDS
from model.rig.actuator_keys import ActuatorOfAnyKind
from model.rig.key_types import (
    AttachedMass,
    Foot,
    Frequency,
    Identifier,
    LossRatio,
    Place,
    Share,
    SmallMass,
    SpringDamping,
    SpringStiffness,
    ThresholdSet,
    check_ascending,
    check_url,
    place_on,
)
from model.rig.plate_sections import PlateSection, SurfaceSection
from model.rig.rig import BOUNDS, Uncertainty
from model.structure.attachments import (
    DEFAULT_POINTS,
    EDGE_FOOT,
    FEET,
    FEET_DEVIATE,
    FOOT_LOSS,
    FootKind,
    PointLoad,
    edge_points,
)
from model.structure.plate import Plate
from registry.limits import GuardLimits

Edges = Literal["edges"]
Points = Annotated[int, Field(ge=3, le=40)]
TissueStiffness = Annotated[float, Quantity(STIFFNESS, at_least=0, at_most=1e6)]


def _given(value: float | None, key: str) -> float:
    """Return the value of a required key; raises InputError without it."""
    if value is None:
        raise InputError(f"{key}: missing; add it")
    return value


class MassSection(Section):
    """Mass on the plate, at a point or on a disc, or along all edges."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [{"required": ["at", "mass"]}, {"required": ["along", "mass_per_length"]}]
        }
    )

    at: Place | None = None
    """`[x, y]`, on the plate.

    Default: required, or `along`
    """

    mass: AttachedMass | None = None
    """Mass at the point.

    Default: required with `at`
    """

    foot: Foot = 0.0
    """Radius of its contact disc, 0 for a point."""

    along: Edges | None = None
    """`edges` for a frame bonded to all edges, instead of `at`."""

    mass_per_length: Annotated[float, Quantity(LINE_MASS, at_least=0, at_most=100)] | None = None
    """Frame mass per length.

    Default: required with `along`
    """

    points: Points = DEFAULT_POINTS
    """Number of points per edge at which a frame acts; increase it for many waves along an edge."""

    def build(self, plate: Plate) -> tuple[PointLoad, ...]:
        """Build the mass on a plate, or the masses of a frame along its edges."""
        if self.at is not None:
            x, y = place_on(plate, self.at)
            mass = _given(self.mass, "mass")
            return (PointLoad(x, y, mass=mass, foot=self.foot),)
        per_length = _given(self.mass_per_length, "mass_per_length")
        return tuple(
            PointLoad(x, y, mass=per_length * length, foot=EDGE_FOOT)
            for x, y, length in edge_points(plate, self.points)
        )


class SupportSection(Section):
    """Passive foot under the plate, or support along its edges."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [
                {
                    "required": ["at"],
                    "anyOf": [{"required": ["kind"]}, {"required": ["stiffness"]}],
                },
                {"required": ["along", "stiffness_per_length"]},
            ]
        }
    )

    at: Place | None = None
    """`[x, y]`, on the plate.

    Default: required, or `along`
    """

    kind: FootKind | None = None
    """Type of foot, which sets its stiffness [as listed](#supports) unless `stiffness` is given."""

    stiffness: SpringStiffness | None = None
    """Stiffness of its spring.

    Default: required with `at`, or `kind`
    """

    loss_factor: LossRatio | None = None
    """Loss factor eta of the spring, k (1 + i eta).

    Default: [as listed](#supports), or 0 with `damping`
    """

    damping: SpringDamping | None = None
    """Viscous damping (along edges, in total), instead of a loss factor or in addition to it."""

    foot: Foot = 0.0
    """Radius of its contact disc, 0 for a point; required if the stiffness is 1 MN/m or more."""

    along: Edges | None = None
    """`edges` for a support along all edges, such as foam tape, instead of `at`."""

    stiffness_per_length: (
        Annotated[float, Quantity(LINE_STIFFNESS, above=0, at_most=1e9)] | None
    ) = None
    """Stiffness per length along the edges.

    Default: required with `along`
    """

    points: Points = DEFAULT_POINTS
    """Number of points per edge at which it acts; increase it for many waves along an edge."""

    def build(self, plate: Plate) -> tuple[PointLoad, ...]:
        """Build the foot under a plate, or springs along its edges."""
        damping, loss_factor = self.damping or 0.0, self.loss_factor
        if loss_factor is None:
            loss_factor = FOOT_LOSS if self.damping is None else 0.0
        spring = PointLoad(0.0, 0.0, damping=damping, loss_factor=loss_factor)
        if self.at is not None:
            x, y = place_on(plate, self.at)
            of_kind = None if self.kind is None else FEET[self.kind]
            stiffness = _given(self.stiffness or of_kind, "stiffness")
            foot = replace(spring, x=x, y=y, stiffness=stiffness, foot=self.foot, is_foot=True)
            return (foot,)
        edge = 2 * (plate.length + plate.width)
        per_length = _given(self.stiffness_per_length, "stiffness_per_length")
        return tuple(
            replace(
                spring,
                x=x,
                y=y,
                stiffness=per_length * length,
                damping=damping * length / edge,
                foot=EDGE_FOOT,
            )
            for x, y, length in edge_points(plate, self.points)
        )


class AmplifierSection(Section):
    """Amplifier: its URL, and the meaning of its full level."""

    url: Annotated[str, AfterValidator(check_url)]
    """Address: `sim://`, `serial:///dev/ttyUSB0?baud=921600`.

    Limits: [`SCHEME://...`](urls.md)
    """

    full_level: Literal["motion", "output"] | None = None
    """Quantity played at level 1.

    Default: `output` if it drives an exciter, else `motion`

    Limits: `motion`, `output`
    """

    clock_error: Annotated[
        float | Literal["unknown"], Quantity(TIME, at_least=0, at_most=0.001, word="unknown")
    ] = 5e-6
    """Clock error assumed by `era config check`; once connected, the amplifier states its own.

    Limits: 0 to 1 ms, or `unknown` for a clock that cannot be steered
    """


def _within(key: str, unit: Dimension = RATIO) -> Quantity:
    """Return the bounds of a parameter of an `Uncertainty`."""
    return Quantity(unit, at_least=BOUNDS[key][0], at_most=BOUNDS[key][1])


class UncertaintySection(Section):
    """Standard deviations of a rig's parameters, with the defaults and bounds of `Uncertainty`."""

    gain: Annotated[float, _within("gain")] = Uncertainty.gain
    """Gain of each channel, relative."""

    phase_deg: Annotated[float, _within("phase_deg")] = Uncertainty.phase_deg
    """Phase of each channel, in degrees."""

    thickness: Annotated[float, _within("thickness")] = Uncertainty.thickness
    """Thickness of the plate, relative."""

    stiffness: Annotated[float, _within("stiffness")] = Uncertainty.stiffness
    """Stiffness of each ERA, relative."""

    damping: Annotated[float, _within("damping")] = Uncertainty.damping
    """Factor, for the ERAs' damping and, independently, the plate's loss factor."""

    fingertip: Annotated[float, _within("fingertip")] = Uncertainty.fingertip
    """Natural logarithm of each finger's load."""

    common_gain: Annotated[float, _within("common_gain")] = Uncertainty.common_gain
    """Common gain of all channels, relative; affects levels only."""

    level: Annotated[float, _within("level")] = Uncertainty.level
    """Change of the gain of each ERA from full level to a tenth of it, relative, by hysteresis or
    creep; the phase changes by half as much in radians."""

    field: Annotated[float, _within("field")] = Uncertainty.field
    """Acceleration caused by each ERA at a finger, relative to its RMS over the plate, from causes
    that no other key describes.
    """

    modulus: Annotated[float, _within("modulus")] = Uncertainty.modulus
    """Modulus of elasticity of the plate, relative; it counts as 0 if `thickness` is 0."""

    place: Annotated[float, _within("place", LENGTH)] = Uncertainty.place
    """Position of each ERA, along x and along y."""

    touch_position: Annotated[float, _within("touch_position", LENGTH)] = Uncertainty.touch_position
    """Distance of each finger from the position that the touch source reports, root mean square; a
    calibration by points [replaces the default](touch.md#from-the-sensor-to-the-plate).
    """

    harmonic: Annotated[float, _within("harmonic")] = Uncertainty.harmonic
    """Second harmonic of each ERA's motion relative to its own amplitude, at any phase."""

    supports: Annotated[float, _within("supports")] | None = None
    """Natural logarithm of the stiffness of each foot.

    Default: 0.3 if the rig has feet, else 0
    """

    weather: Annotated[float, _within("weather")] | None = None
    """Modulus of the plate due to temperature and moisture, relative; also used if `thickness` is
    0.

    Default: from `plate.temperature` and `plate.humidity`, see [weather](#weather), else 0
    """

    foreign_mass: Annotated[float, _within("foreign_mass", MASS)] = Uncertainty.foreign_mass
    """Mass of an object that can be anywhere on the plate, such as a 200 g cup; see [what lies on
    the plate](../concepts/people.md#objects-on-the-plate).
    """

    mode_frequency: Annotated[float, _within("mode_frequency")] = Uncertainty.mode_frequency
    """Natural frequency of each mode individually, relative: the difference between a computed
    [surface](#surface) and the built part.
    """

    mode_amplitude: Annotated[float, _within("mode_amplitude")] = Uncertainty.mode_amplitude
    """Amplitude of each mode shape of a surface individually, relative."""

    def build(self, *, has_feet: bool, weather: float) -> Uncertainty:
        """Build the uncertainty of a rig; for feet, default `FEET_DEVIATE`.

        weather: default, from the plate.
        """
        values = {"supports": FEET_DEVIATE if has_feet else 0.0, "weather": weather}
        values |= self.model_dump(exclude_none=True)
        return Uncertainty(**values)


class FingertipSection(Section):
    """Load of a fingertip, see `Fingertip`; a missing key has its default value."""

    stiffness: TissueStiffness = 1000.0
    """Stiffness of the pulp."""

    damping: Annotated[float, Quantity(DAMPING, above=0, at_most=1e4)] = 2.0
    """Damping of the pulp."""

    contact_mass: SmallMass = 0.0002
    """Mass that moves with the plate."""

    phalanx_mass: Annotated[float, Quantity(MASS, at_least=1e-5, at_most=1)] = 0.005
    """Mass of the bone behind the pulp."""

    joint_stiffness: TissueStiffness = 500.0
    """Stiffness of the joint that holds the bone."""

    joint_damping: Annotated[float, Quantity(DAMPING, at_least=0, at_most=1e4)] = 2.0
    """Damping of that joint."""


class LimitsSection(Section):
    """Limits of commands, see `GuardLimits`; all except the frequencies are unlimited by default.

    The default frequencies are in the range that skin feels well.
    """

    frequency: Annotated[
        tuple[Frequency, Frequency], Strict(strict=False), AfterValidator(check_ascending)
    ] = (40.0, 500.0)
    """Lowest and highest mechanical drive frequency."""

    level: Share = 1.0
    """Maximum level, as a fraction of full level (an ERA's stroke)."""

    slew: Annotated[float, Quantity(SLEW, above=0, at_most=1e6)] | None = None
    """Maximum rise of a level; `2 %/ms` is from rest to full stroke in 50 ms. Ramps are lengthened
    accordingly; an envelope that rises faster is rejected. The rise is an average over the ramp,
    starting at the lowest level that can be playing; a raised cosine is 1.6 times as steep in its
    middle.
    """

    power: Annotated[float, Quantity(RATIO, above=0, at_most=256)] | None = None
    """Maximum sum of the squared levels of an amplifier's channels; 1 is one channel at full
    stroke, or four channels at half stroke.
    """

    on_time: Annotated[float, Quantity(TIME, above=0, at_most=86_400)] | None = None
    """Longest continuous vibration of an amplifier, including ramps; the amplifier then ends it on
    its own."""

    duty: Annotated[float, Quantity(RATIO, above=0, at_most=1)] | None = None
    """Maximum fraction of any ten seconds in which an amplifier vibrates, including ramps."""

    rate: Annotated[float, Quantity(RATE, at_least=1, at_most=2000)] | None = None
    """Maximum number of command sets per second sent to one amplifier, other than silence. Sets are
    counted over 1.1 s, so that the amplifier never gets more in one second even if some are
    delayed. A rejected set is played as soon as the limit allows.
    """

    def build(self) -> GuardLimits:
        """Build the limits, infinite unless given."""
        low, high = self.frequency
        limits = self.model_dump(exclude={"frequency"}, exclude_none=True)
        return GuardLimits(frequency_min=low, frequency_max=high, **limits)


def _file_of_modes(value: object) -> object:
    """Convert the name of a file to the keys of a surface."""
    return {"modes": value} if isinstance(value, str) else value


def _none_or_section(value: object, section: ValidatorFunctionWrapHandler) -> object:
    """Validate the keys of a section, or the word `none`."""
    return value if value == "none" else section(value)


class RigSection(Section):
    """A rig file.

    - mesh: auto, auto 1 %, NXxNY, or NXxNY ELEMENT.
    - uncertainty: default for a plate without measurements.
    - fingertip: none for massless fingers.
    - threshold: a set of detection thresholds.
    - promised_thresholds: sets for which promises hold.
    """

    plate: PlateSection | None = None
    """The plate; see [plate](#plate).

    Default: required, or `surface`
    """

    surface: Annotated[
        SurfaceSection | None,
        BeforeValidator(_file_of_modes, json_schema_input_type=SurfaceSection | str | None),
    ] = None
    """Modes from another program, instead of a plate; see [surface](#surface).

    Limits: a mapping, or a file of modes
    """

    mesh: str = "auto"
    """`auto A %` uses polynomials over the plate for a response error of A % up to the upper
    `limits.frequency` (`auto`: 1 %), or elements if that takes too many polynomials; see [the plate
    model](../concepts/plate-model.md). Otherwise: the number of elements along x and y, of type
    MITC4, Q3, Q4 or Q5, with a narrow row along every edge if strips are given; or polynomial
    degrees with `Legendre` as the element. A mesh with fewer than six elements per bending
    wavelength at that frequency is rejected.

    Limits: `auto`, `auto A %` with A from 0.05 to 10, `NXxNY` with 1 to 1000 a side, `NXxNY
    ELEMENT`, or `NXxNY ELEMENT with strips of W`
    """

    eras: Annotated[dict[Identifier, ActuatorOfAnyKind], Field(min_length=1, max_length=64)]
    """ERAs or exciters by name; see [eras](#eras) and [exciters](#exciters)."""

    masses: Annotated[dict[Identifier, MassSection], Field(max_length=64, default_factory=dict)]
    """Masses by name; see [masses](#masses)."""

    supports: Annotated[
        dict[Identifier, SupportSection], Field(max_length=64, default_factory=dict)
    ]
    """Passive supports of the plate by name; see [supports](#supports)."""

    amplifiers: Annotated[dict[Identifier, AmplifierSection], Field(min_length=1)]
    """Amplifiers by name; see [amplifiers](#amplifiers)."""

    limits: LimitsSection = LimitsSection()
    """Limits of drive commands; see [limits](#limits)."""

    uncertainty: UncertaintySection = UncertaintySection()
    """Uncertainty of the rig; see [uncertainty](#uncertainty)."""

    fingertip: Annotated[
        FingertipSection,
        # Not a union, since pydantic would name both alternatives in errors.
        WrapValidator(_none_or_section, json_schema_input_type=FingertipSection | Literal["none"]),
    ] = FingertipSection()
    """Load of each finger on the plate, see [fingertip](#fingertip); `none` for massless fingers.

    Limits: a mapping, or `none`
    """

    threshold: ThresholdSet = DEFAULT_THRESHOLD
    """Threshold set to which levels in dB SL refer; see
    [people](../concepts/people.md#detection-thresholds).

    Limits: `vibrotactile-probe`, `pressing-fingertip`
    """

    promised_thresholds: Annotated[
        list[ThresholdSet],
        Field(min_length=1, default_factory=lambda: [*PUBLISHED_THRESHOLDS]),
    ]
    """Threshold sets for which promises hold: the set with the lowest promise counts, and
    `threshold` always counts. Default: all published sets. To base promises on `threshold` alone,
    list only that set.

    Limits: a list of `vibrotactile-probe`, `pressing-fingertip`
    """
