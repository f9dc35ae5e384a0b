"""Declaration of a check: the steps that a module of checks decorates."""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from inspect import getdoc
from typing import Any, TypeAlias

from era_haptics.lab.conformance.request_rows import RequestRows

Steps: TypeAlias = Callable[[Any], Awaitable[None] | RequestRows]
"""Steps of a check: a coroutine for a Subject or its JudgeClient, or rows to carry out."""


@dataclass(frozen=True, slots=True)
class ConformanceCheck:
    """Check of a protocol rule.

    title: stimulus and required reaction. place: page and heading of the rule, as an anchor.
    drives: whether it arms the amplifier. kinds: kinds of wire it applies to, empty for all.
    greets: whether it uses only Hello. remedy: what to change in the firmware if it fails.
    """

    name: str
    title: str
    place: str
    drives: bool
    kinds: tuple[str, ...]
    steps: Steps
    greets: bool = False
    remedy: str = ""


def reading(
    place: str, *kinds: str, drives: bool = False, greets: bool = False
) -> Callable[[Steps], ConformanceCheck]:
    """Decorate the steps of a check that only reads.

    The first paragraph of their docstring is the title, the second one the remedy.
    """

    def declare(steps: Steps) -> ConformanceCheck:
        name = getattr(steps, "__name__", "")
        paragraphs = (getdoc(steps) or "").partition("\n\n")
        title = " ".join(paragraphs[0].split()).removesuffix(".")
        remedy = " ".join(paragraphs[2].split())
        return ConformanceCheck(name, title, place, drives, kinds, steps, greets, remedy)

    return declare


driving = partial(reading, drives=True)
"""Decorates the steps of a check that arms the amplifier and drives its channels."""
