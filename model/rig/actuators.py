"""Kinds of actuators of a rig file, a row each."""

from collections.abc import Callable, Iterator, Mapping, Set
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

from model.config.sections import ByKind
from model.rig.actuator_section import ActuatorSection
from model.rig.era_section import EraSection, era_of, era_problems
from model.rig.exciter_section import ExciterSection, exciter_of, exciter_problems
from model.structure.actuators import Actuator
from model.structure.attachments import Era
from model.structure.exciter import Exciter
from model.structure.plate import Plate

ActuatorOfAnyKind: TypeAlias = Annotated[EraSection | ExciterSection, ByKind()]
"""Sections of which `kind` chooses one, ERAs by default."""


@dataclass(frozen=True)
class ActuatorKind:
    """One kind of actuators.

    section: its keys; make: an actuator of its name, its section, the plate and the number of
    actuators; problems: by key, of the keys given and the value of a key that is valid; keys: by
    field of the actuator that a fit changes; restated: those of them that depend on the rest of
    the rig, and are always written; instead: keys that each replaces; is_electrical: whether its
    full level is a voltage, so that an amplifier which drives it is an output.
    """

    section: type[ActuatorSection]
    make: Callable[[str, Any, Plate, int], Actuator]
    problems: Callable[[Set[str], Callable[[str], Any]], Iterator[tuple[str, str]]]
    keys: Mapping[str, str]
    restated: tuple[str, ...]
    instead: Mapping[str, tuple[str, ...]]
    is_electrical: bool = False


_GAINS = {"gains": "gains"}
_SUSPENSION = {"stiffness": "stiffness", "damping": "damping"}

KINDS: Mapping[type[Actuator], ActuatorKind] = {
    Era: ActuatorKind(
        EraSection,
        era_of,
        era_problems,
        keys=_SUSPENSION | {"bolt_mass": "bolt_mass"} | _GAINS,
        restated=("stiffness", "damping", "bolt_mass"),
        instead={"damping": ("damping_ratio",)},
    ),
    Exciter: ActuatorKind(
        ExciterSection,
        exciter_of,
        exciter_problems,
        keys=_SUSPENSION
        | {"magnet_mass": "weight", "coil_mass": "coil_mass", "force_factor": "force_factor"}
        | _GAINS,
        restated=("stiffness", "damping"),
        instead={"stiffness": ("resonance", "resonance_is"), "damping": ("q",)},
        is_electrical=True,
    ),
}
"""By class of the actuator."""


def kind_of(section: ActuatorSection | type[ActuatorSection]) -> ActuatorKind:
    """The kind of a section."""
    own = section if isinstance(section, type) else type(section)
    return next(kind for kind in KINDS.values() if kind.section is own)
