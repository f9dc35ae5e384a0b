"""Kinds of actuators of a rig file, a row each."""

from collections.abc import Mapping
from typing import Annotated, TypeAlias

from model.config.fields import ByKind
from model.rig.actuator_section import ActuatorSection
from model.rig.era_section import EraSection
from model.rig.exciter_section import ExciterSection
from model.structure.actuators import Actuator
from model.structure.attachments import Era
from model.structure.exciter import Exciter

ActuatorOfAnyKind: TypeAlias = Annotated[EraSection | ExciterSection, ByKind()]
"""Sections of which `kind` chooses one, ERAs by default."""

KINDS: Mapping[type[Actuator], type[ActuatorSection]] = {Era: EraSection, Exciter: ExciterSection}
"""Section by class of the actuator."""
