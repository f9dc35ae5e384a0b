"""The check of a rig's amplifiers by the package that knows wires."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pkgutil import resolve_name
from typing import Protocol
from urllib.parse import quote

from model.config.document import Document, Problem
from model.rig.parts import limits_of
from model.rig.rig import Rig
from model.rig.sections import LimitsSection
from registry.limits import GuardLimits


class RigCheck(Protocol):
    """Checks URLs without opening any."""

    def __call__(
        self, urls: Mapping[str, str], *, channels: Mapping[str, int], limits: GuardLimits
    ) -> tuple[Mapping[str, str], Sequence[str]]:
        """Errors by the amplifier's name, and warnings.

        channels: number wired by amplifier; limits: of the rig.
        """


_CHECK = "drivers.by_hand.rig_check:check_links"
"""By name: this package does not import the one beside it."""


def check_amplifiers(document: Document, rig: Rig | None) -> tuple[list[Problem], list[str]]:
    """Problems and warnings; rig: of the document, None if it is invalid."""
    urls = _urls(document)
    wired = Counter(channel.amplifier for channel in rig.wiring.values()) if rig else Counter()
    limits = rig.limits if rig else limits_of(LimitsSection())
    check: RigCheck = resolve_name(_CHECK)
    wrong, warnings = check(urls, channels=wired, limits=limits)
    problems = [
        document.problem(("amplifiers", amplifier, "url"), what)
        for amplifier, what in wrong.items()
    ]
    return problems, [*warnings]


def _urls(document: Document) -> dict[str, str]:
    """All URLs that are text; `sim://` becomes a simulated amplifier over this rig."""
    amplifiers = document.data.get("amplifiers")
    urls = {}
    for name, amplifier in amplifiers.items() if isinstance(amplifiers, dict) else ():
        url = amplifier.get("url") if isinstance(amplifier, dict) else None
        if isinstance(url, str):
            here = f"sim://{quote(document.source)}?amplifier={quote(str(name))}"
            urls[name] = here if url == "sim://" else url
    return urls
