"""Fault files:

seed: 7                      # makes faults reproducible
faults:
  - {fault: drop, at: 2, lasts: 10, share: 0.2}         # seconds
  - {fault: unplug, at: 15, lasts: 0.5, amplifier: main}
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import ValidationError

from model.config.document import read_document
from model.config.sections import Quantity, Section, Validation
from model.config.units import RATIO, TIME
from model.errors import InputError, first_problem
from sim.faults.fault_window import FaultKind, Faults, FaultWindow, Toward


class _FaultSection(Section):
    fault: FaultKind
    at: Annotated[float, Quantity(TIME, at_least=0)] = 0.0
    lasts: Annotated[float, Quantity(TIME, above=0)] = math.inf
    amplifier: str | None = None
    share: Annotated[float, Quantity(RATIO, above=0, at_most=1)] = 1.0
    toward: Toward | None = None
    delay: Annotated[float, Quantity(TIME, above=0, at_most=10)] = 0.1


class _FaultFileSection(Section):
    seed: int = 0
    faults: list[_FaultSection]


@dataclass(frozen=True)
class FaultFile:
    """Fault windows for the amplifiers of a rig."""

    windows: tuple[FaultWindow, ...]
    seed: int = 0

    def of(self, amplifier: str, *, begin: float) -> Faults:
        """The faults of one amplifier; begin [s]: when their time scale begins."""
        own = [window for window in self.windows if window.amplifier in (None, amplifier)]
        return Faults(own, begin=begin, seed=self.seed)


def load_faults(path: Path, *, amplifiers: Collection[str]) -> FaultFile:
    """Read a fault file; raises ConfigError with every problem, by file, line and key."""
    document = read_document(path)
    validation = Validation(document, _FaultFileSection)
    listed = document.data.get("faults")
    for number, entry in enumerate(listed if isinstance(listed, list) else []):
        name = entry.get("amplifier") if isinstance(entry, dict) else None
        if isinstance(name, str) and name not in amplifiers:
            known = ", ".join(sorted(amplifiers))
            validation.add(("faults", number, "amplifier"), f"must be one of {known}, got {name!r}")
    section = validation.finish()
    windows = tuple(FaultWindow(**window.model_dump()) for window in section.faults)
    return FaultFile(windows, seed=section.seed)


def parse_fault(given: Mapping[str, Any]) -> FaultWindow:
    """Parse one fault, with the keys of a fault file; raises InputError."""
    try:
        return FaultWindow(**_FaultSection.model_validate(dict(given)).model_dump())
    except ValidationError as error:
        key, problem = first_problem(error)
        raise InputError(f"{key}: {problem}") from None
