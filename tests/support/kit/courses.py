"""Courses in virtual time: lists of steps in a YAML file, by the sentence that they prove.

A step is a method of what is played or, with dots, of its parts; or `is`: values as `fits` compares
them, each by the name of a property or method, or by a Python expression of such names:
`len(taken)`, `hosts.a.status["levels"][0]`. What is given by number, as of fingers, is given as it
is; `now` in a list is the time [s].
"""

import asyncio
import inspect
import logging
import operator
import random
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from cases import read_yaml
from drivers import errors
from drivers.errors import CommandError, CommandRefused
from drivers.protocol.definition import FAULTS, STATES
from drivers.protocol.records import Refusal, Values
from kit.chain import FINGER, OTHER, Chain
from kit.clock import run_virtual
from model.vibration import Tone
from registry import threads
from sim.faults import FaultKind

Step = str | Mapping[str, Any]
FINGERS = {
    "finger": FINGER,
    "near": (FINGER[0], FINGER[1] + 0.001, FINGER[2]),
    "moved": (FINGER[0], 0.18, 0.1),
    "elsewhere": (FINGER[0], *OTHER[1:]),
    "other": OTHER,
}
"""Fingers by name; those that are near, moved or elsewhere are the finger at another place."""


class Planted(Exception):
    """A bug."""


class Names(dict[str, Any]):
    """What the names in an expression mean: attributes of what is played, and a few functions.

    A property is looked up only when the expression names it.
    """

    def __init__(self, played: object) -> None:
        few = (abs, all, any, dict, len, list, max, min, round, set, sorted, sum)
        super().__init__({each.__name__: each for each in few}, __builtins__={})
        self.played = played

    def __missing__(self, name: str) -> Any:
        return getattr(self.played, name)


@dataclass(kw_only=True)
class Taken:
    """What takes the steps of courses; under_way: those that have begun; error: the last of one.

    log: what is logged meanwhile.
    """

    under_way: dict[str, "asyncio.Task[None]"] = field(default_factory=dict)
    error: Exception | None = None
    log: list[logging.LogRecord] = field(default_factory=list)

    @property
    def logged(self) -> str:
        """The text of all that was logged, tracebacks included."""
        return "\n".join(map(logging.Formatter().format, self.log))

    @property
    def levels_logged(self) -> list[str]:
        """The level of each record."""
        return [each.levelname for each in self.log]

    def value(self, expression: str) -> Any:
        """What an expression is, or what the method that it names returns."""
        names = Names(self)
        found = eval(expression, names, names)
        return found() if callable(found) else found

    async def waits(self, seconds: float) -> None:
        """Let time pass."""
        await asyncio.sleep(seconds)

    async def begins(self, step: Step) -> None:
        """Begin a step, and let the loop turn."""
        self.under_way[_name(step)] = asyncio.create_task(self.take(step))
        await asyncio.sleep(0)

    async def ends(self, step: Step) -> None:
        """Wait until a step was taken."""
        await self.under_way.pop(_name(step))

    async def ends_anyhow(self, step: Step) -> None:
        """Wait until a step was taken, or refused."""
        await asyncio.gather(self.under_way.pop(_name(step)), return_exceptions=True)

    async def repeats(self, count: int, steps: Sequence[Step]) -> None:
        """Take steps so often."""
        for step in [*steps] * count:
            await self.take(step)

    def cancels(self, step: Step) -> None:
        """Cancel a step that has begun."""
        self.under_way[_name(step)].cancel()

    def breaks(self, what: str) -> None:
        """Let a method, by its name, fail by a bug from now on."""
        owner, _, name = what.rpartition(".")
        setattr(attrgetter(owner)(self), name, Mock(side_effect=Planted(what)))

    def sets(self, **values: Any) -> None:
        """Give attributes, by their names, values."""
        for what, value in values.items():
            owner, _, name = what.rpartition(".")
            setattr(attrgetter(owner)(self) if owner else self, name, value)

    def says(self, what: str, text: str) -> None:
        """Require a part of a text."""
        assert text in self.value(what), self.value(what)

    def lacks(self, what: str, text: str) -> None:
        """Require that a text is no part of another."""
        assert text not in self.value(what), self.value(what)

    def counts(self, **numbers: int) -> None:
        """Require the numbers of what was reported."""
        found = {what: len(self.value(what)) for what in numbers}
        assert found == numbers

    async def refuses(self, step: Step) -> None:
        """Require that a step is refused."""
        await self.refuses_saying(".", step)

    async def refuses_saying(self, text: str, step: Step) -> None:
        """Require that a step is refused, with this text."""
        with pytest.raises((CommandError, CommandRefused), match=text):
            await self.take(step)

    async def take(self, step: Step) -> None:
        """Take a step."""
        ((name, given),) = step.items() if isinstance(step, Mapping) else [(step, [])]
        if name == "is":
            found = {what: self.value(what) for what in given}
            assert fits(found, given), {what: found[what] for what in given}
            return
        method = attrgetter(name.replace(" ", "_"))(self)
        if isinstance(given, list):
            given = [threads.now() if each == "now" else each for each in given]
        is_by_number = isinstance(given, Mapping) and any(isinstance(key, int) for key in given)
        if name in _OF_A_STEP or is_by_number or not isinstance(given, list | Mapping):
            done = method(given)
        else:
            done = method(**given) if isinstance(given, Mapping) else method(*given)
        if inspect.isawaitable(done):
            await done

    async def raises(self, error: str, step: Step, text: str = ".") -> None:
        """Require that a step raises an error of the drivers, or Planted, by name, with a text."""
        kind = Planted if error == "Planted" else getattr(errors, error)
        with pytest.raises(kind, match=text) as caught:
            await self.take(step)
        self.error = caught.value

    async def takes(self, least: float, most: float, step: Step) -> None:
        """Require that a step takes so many seconds."""
        began = threads.now()
        async with asyncio.timeout(most + 1.0):
            await self.take(step)
        assert least <= threads.now() - began <= most


@dataclass
class Acted(Taken, Chain):
    """A chain that takes the steps of courses; whole: methods that fail, as they are."""

    whole: dict[str, Any] = field(default_factory=dict)

    @property
    def amplifiers(self) -> str:
        """Their states, each once."""
        return ", ".join(dict.fromkeys(each.state for each in self.far_ends))

    @property
    def is_loud(self) -> bool:
        """Whether any amplifier plays."""
        return any(map(any, self.levels().values()))

    @property
    def is_armed(self) -> bool:
        """Whether any amplifier is."""
        return "OPERATION_ENABLED" in self.amplifiers.split(", ")

    def played(self) -> list[list[Any]]:
        """The commands of each set that vibrates, of the first amplifier."""
        return [[*one.layer.commands] for one in self.far_end.sent() if not one.is_silent]

    @property
    def keep_phase(self) -> list[list[bool]]:
        """Of each set that vibrates, the channels that continue their phase."""
        return [[each.keep_phase for each in commands] for commands in self.played()]

    def touch(self, *fingers: str, ago: float = 0.0) -> None:
        """Put fingers down in place of all that are, once."""
        self.put(*(FINGERS[each] for each in fingers), ago=ago)

    def touch_of(self, ago: float, *fingers: str) -> None:
        """Do the same by a frame that arrived some time ago."""
        self.touch(*fingers, ago=ago)

    async def holds(self, seconds: float, *fingers: str) -> None:
        """Hold fingers for a time."""
        await self.hold(seconds, down=[FINGERS[each] for each in fingers])

    def answers_by(self, **tones: Sequence[float]) -> None:
        """Have the table answer by frequencies [Hz] and amplitudes [m], by ERA."""
        self.table.excitation = {era: Tone(*tone) for era, tone in tones.items()}

    def fails(self, *methods: str) -> None:
        """Let methods of the controller, or of its cycle, fail from now on."""

        def fail(*_: object) -> None:
            raise Planted(*methods)

        for method in methods:
            self.whole[method] = getattr(self._owner(method), method)
            setattr(self._owner(method), method, fail)

    def works(self, *methods: str) -> None:
        """Let methods that fail work again."""
        for method in methods:
            setattr(self._owner(method), method, self.whole.pop(method))

    def _owner(self, method: str) -> object:
        return self.controller.cycle if method == "step" else self.controller

    async def is_late_for(self, kind: str, seconds: float) -> None:
        """Wait for a request of a kind; its reply, and those after it, leave so much later."""
        requested = asyncio.Event()

        def note(name: str, values: Values) -> None:
            if name == kind:
                self.far_end.delay(seconds)
                requested.set()

        self.far_end.answer = note
        await requested.wait()
        self.far_end.answer = lambda name, values: None
        await asyncio.sleep(0.001)

    def fault(self, kind: FaultKind, of: int | None = None, **given: Any) -> None:
        """Let a fault of all amplifiers begin, or of one by its number."""
        for each in self.far_ends if of is None else [self.far_ends[of]]:
            each.fault(kind, **given)

    def recovers(self, of: int | None = None) -> None:
        """End all faults, or those of one amplifier by its number."""
        for far_end in self.far_ends if of is None else [self.far_ends[of]]:
            far_end.recover()

    def delays(self, seconds: float) -> None:
        """Let replies of all amplifiers leave them so much later."""
        for each in self.far_ends:
            each.delay(seconds)

    def obey(self) -> None:
        """Let the amplifiers obey again, and forget the requests so far."""
        self.forget()
        self.delays(0.0)
        self.recovers()
        for each in self.far_ends:
            each.answer = lambda name, values: None

    def forget(self) -> None:
        """Forget the requests so far, and how often a line was opened."""
        self.operation.attempts.clear()
        for each in self.far_ends:
            each.asked.clear()

    def answer(self, *names: str, **changed: object) -> None:
        """Let the amplifier report something else in replies of some names."""
        changed = {what: _coded(what, value) for what, value in changed.items()}

        def lie(name: str, values: Values) -> Values | None:
            if name in names:
                return {**self.far_end.obey(name, values, threads.now()), **changed}
            return None

        self.far_end.lie(lie)

    def answers(self, to: Sequence[str], **changed: object) -> None:
        """Do the same by names in a list."""
        self.answer(*to, **changed)

    def freezes(self, seconds: float) -> None:
        """Let the amplifier ignore Clear, and report what it reports now, for so long."""
        until = threads.now() + seconds
        status = self.far_end.status()
        self.far_end.lie(
            lambda name, values: (
                status if threads.now() < until and name in ("Clear", "GetStatus") else None
            )
        )

    def reports(self, when: str, **event: Any) -> None:
        """Let the amplifier send an event as it is about to carry out a request of a name."""
        values = {"latch": 0, **{what: _coded(what, value) for what, value in event.items()}}

        def report(name: str, _: Values) -> None:
            for listener in self.far_end.device.listeners:
                if name == when:
                    listener(values, threads.now())

        self.far_end.lie(report)

    def refuse(self, *names: str) -> None:
        """Let the last amplifier refuse requests of some names."""

        def answer(name: str, values: Values) -> None:
            if name in names:
                raise Refusal("as told", "WRONG_STATE")

        self.far_ends[-1].lie(answer)

    def asked(self, of: int = 0, **least: int) -> None:
        """Require that an amplifier, by its number, was asked so often or more; never for 0."""
        for name, count in least.items():
            found = len(self.far_ends[of].requests(name))
            assert found >= count, (name, found)
            assert count or not found, (name, found)

    def asked_in_order(self, *names: str) -> None:
        """Require that the amplifier was asked first for the one, then for the other."""
        kinds = self.far_end.names()
        found = [kinds.index(name) for name in names]
        assert found == sorted(found), kinds


_COMPARED = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge}


def fits(found: Any, wanted: Any) -> bool:
    """Whether a value is as it is wanted: the same, or as one of the texts below.

    By key in mappings, one by one in lists; what is neither is wanted of each that is in one.
    """
    if isinstance(wanted, Mapping):
        return found.keys() == wanted.keys() and all(
            fits(found[key], wanted[key]) for key in wanted
        )
    if isinstance(wanted, list):
        return len(found) == len(wanted) and all(map(fits, found, wanted))
    if isinstance(found, Mapping | list | tuple | set):
        values = [*found.values()] if isinstance(found, Mapping) else [*found]
        return bool(values) and all(fits(each, wanted) for each in values)
    match wanted.split() if isinstance(wanted, str) else ():
        case ["<" | "<=" | ">" | ">=" as sign, limit]:
            return bool(_COMPARED[sign](found, float(limit)))
        case [least, "to", most]:
            return bool(float(least) <= found <= float(most))
        case [middle, "+-", width]:
            return bool(abs(found - float(middle)) <= float(width))
        case ["has", *words]:
            return " ".join(words) in str(found)
        case ["any"]:
            return True
    return bool(found == wanted)


def _name(step: Step) -> str:
    """The name of a step, without what it is given."""
    return step if isinstance(step, str) else next(iter(step))


_OF_A_STEP = ("refuses", "begins", "ends", "ends anyhow", "cancels")


def _coded(what: str, value: Any) -> Any:
    """The number of a state or a fault that is named; all else as it is."""
    codes = {"state": STATES, "fault": FAULTS}.get(what, {})
    return codes.get(value, value) if isinstance(value, str) else value


def courses(path: Path) -> dict[str, Mapping[str, Any]]:
    """The courses of a file by their names: `steps`, and options of what they are played on."""
    return dict(read_yaml(path))


def follow(
    course: Mapping[str, Any],
    made: Callable[..., AbstractAsyncContextManager[Taken]],
    rng: random.Random | None = None,
) -> None:
    """Take all steps of a course, in virtual time, on what is made with its options.

    rng: of the virtual loop.
    """
    given = {**course}

    async def run() -> None:
        steps, amplifiers = given.pop("steps"), given.pop("amplifiers", ())
        async with made(*amplifiers, **given) as chain:
            handler = logging.Handler()
            handler.emit = chain.log.append  # type: ignore[method-assign]
            logging.getLogger().addHandler(handler)
            try:
                for number, step in enumerate(steps, 1):  # noqa: B007  said where one fails
                    await chain.take(step)
            except BaseException as error:
                error.add_note(f"step {number} of {len(steps)}: {step}")
                raise
            finally:
                logging.getLogger().removeHandler(handler)

    run_virtual(run(), rng=rng)
