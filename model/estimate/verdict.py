"""Verdict of a rig check: its channels, its plate, and its findings."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from model.arrays import FloatArray
from model.estimate.finding_kinds import FINDING_KINDS
from model.estimate.hypotheses import Hypothesis
from model.estimate.plate_match import Match


@dataclass(frozen=True)
class Finding:
    """A fault or remark that a check reports."""

    kind: str
    """Key of `FINDING_KINDS`."""
    of: str
    """Name of the part it concerns."""
    value: float = 0.0
    """Size, as printed in its text."""
    confidence: float = 1.0
    """Confidence 0..1 in it."""
    chance: float = 1.0
    """Share of plates as written that look as far off or further."""
    details: Mapping[str, Any] = field(default_factory=dict)
    """Additional values for the text."""
    json: Mapping[str, Any] = field(default_factory=dict)
    """Additional JSON keys of the plate: for a `file` its key, for a load or form its
    properties."""

    @property
    def about(self) -> str:
        """Subject; see `FindingKind.about`."""
        return FINDING_KINDS[self.kind].about

    @property
    def rows(self) -> list[str]:
        """Return printed lines: problem and remedy."""
        values = {"of": self.of, "value": self.value, "confidence": self.confidence}
        return FINDING_KINDS[self.kind].text.format(**{**self.details, **values}).splitlines()

    @property
    def rule(self) -> str:
        """Return the first printed line without its heading."""
        return self.rows[0].partition(": ")[2]

    @property
    def is_fault(self) -> bool:
        """Whether it fails the check."""
        return FINDING_KINDS[self.kind].is_fault


@dataclass(frozen=True)
class ChannelVerdict:
    """Verdict on a channel: the ERA it is wired to in the rig, the ERA it drives, and its
    states."""

    era: str
    """ERA to which the rig wires it."""
    amplifier: str
    """Name of its amplifier."""
    channel: int
    """Its number there."""
    states: tuple[str, ...]
    """Problems, as kinds of findings; only "well" without problems, or "not driven"."""
    drives: str | None = None
    """ERA that it drives, None for a dead or undriven channel."""
    gain: float | None = None
    """Gain relative to the command and the rig's gains."""
    phase: float | None = None
    """Phase error [degrees], None if unknown."""
    mac_own: float | None = None
    """Median MAC with the rig's ERA."""
    mac_found: float | None = None
    """Median MAC with the ERA that it drives."""
    confidence: float = 0.0
    """Confidence 0..1 in `drives` and `states`."""

    @property
    def wiring(self) -> str:
        """The channel in words."""
        return f"channel {self.channel} of amplifier {self.amplifier} (ERA {self.era} in the rig)"


@dataclass(frozen=True, eq=False)
class Verdict:
    """Result of a rig check."""

    channels: tuple[ChannelVerdict, ...]
    sensors: tuple[str, ...]
    """Names of the sensors that were used."""
    frequencies: FloatArray
    """Tones that were used (f,) [Hz]."""
    findings: tuple[Finding, ...] = ()
    """Findings, in the order in which to check them."""
    plate_matches: bool = True
    """Whether the rig's plate within its priors explains the measurement."""
    match: Match | None = None
    """That plate."""
    hypotheses: tuple[Hypothesis, ...] = ()
    """Other plates that explain it if the rig's does not, most likely first."""
    changes: Mapping[str, float] | None = None
    """Relative differences from the rig as `plate_changes`, None without a plate that fits."""
    promise_margins: tuple[float, ...] = ()
    """Margins [dB] of the plate's contrasts over the promises of the rig's table; empty if not
    compared."""

    def of_kinds(self, *kinds: str) -> list[Finding]:
        """Return the findings of some kinds."""
        return [finding for finding in self.findings if finding.kind in kinds]

    def about(self, *subjects: str) -> list[Finding]:
        """Return the findings about some subjects; see `FindingKind.about`."""
        return [finding for finding in self.findings if finding.about in subjects]

    @property
    def wiring_matches(self) -> bool:
        """Whether every driven channel drives its own ERA."""
        return all(set(channel.states) <= {"well", "not driven"} for channel in self.channels)

    @property
    def is_well(self) -> bool:
        """Whether no fault was found."""
        return not any(finding.is_fault for finding in self.findings)

    @property
    def kept_share(self) -> float | None:
        """Fraction of the table's promises that the plate keeps, None if not compared."""
        if not self.promise_margins:
            return None
        return float(np.mean(np.array(self.promise_margins) >= 0))
