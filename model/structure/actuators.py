"""Kinds of actuators that drive a plate."""

from typing import TypeAlias, TypeVar

from model.structure.attachments import Era
from model.structure.exciter import Exciter

Actuator: TypeAlias = Era | Exciter
"""Any of them, each a `Source`; further kinds are listed here and in `model.rig.actuator_keys`."""

OneKind = TypeVar("OneKind", Era, Exciter, Actuator)
"""Of a function that gives the kind of actuator that it is given."""
