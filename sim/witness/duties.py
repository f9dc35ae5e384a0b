"""What a host owes within a time: silence, patterns and stops; looked at when the time is over."""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass

from sim.witness.people import People
from sim.witness.plan import Times
from sim.witness.side import Side


@dataclass
class _Duty:
    """What must have happened when a time [s] is over; is_done is asked then."""

    due: float
    is_done: Callable[[], bool]
    invariant: str
    side: Side
    sentence: str


class Duties:
    """Those of a host of these amplifiers; what a fault of a wire excuses is not complained of."""

    def __init__(self, sides: Mapping[str, Side], people: People, *, times: Times) -> None:
        self._sides = sides
        self._people = people
        self._times = times
        self._due: list[_Duty] = []

    def pass_to(self, time: float) -> None:
        """Look at those whose time is over."""
        if any(duty.due < time for duty in self._due):
            over = [duty for duty in self._due if duty.due < time]
            self._due = [duty for duty in self._due if duty.due >= time]
            for duty in over:
                if not (duty.side.is_troubled(duty.due) or duty.is_done()):
                    duty.side.complain(duty.invariant, duty.due, duty.sentence)

    def silence(self, lifted: float) -> None:
        """The last finger has gone."""
        for side in self._sides.values():
            self._due.append(
                _Duty(
                    lifted + self._times.lift,
                    lambda side=side: self._is_released(side, lifted),  # type: ignore[misc]
                    "lift",
                    side,
                    f"the last finger was lifted at {lifted:.4f} s, and "
                    f"{self._times.lift * 1e3:g} ms later {side.name} was not told to be silent",
                )
            )

    def pattern(self, contact: Hashable, since: float) -> None:
        """A finger has come."""
        if not self._can_play():
            return
        self._due.append(
            _Duty(
                since + self._times.touch,
                lambda: self._is_answered(contact, since),
                "touch",
                next(iter(self._sides.values())),
                f"a finger came at {since:.4f} s, and {self._times.touch * 1e3:g} ms later no "
                "amplifier plays a pattern for it",
            )
        )

    def stop(self, side: Side, time: float) -> None:
        """A stop was wished."""
        side.stop_wished = time
        self._due.append(
            _Duty(
                time + self._times.stop,
                lambda: side.stop_wished != time or not side.is_open,
                "stop",
                side,
                f"a stop was wished at {time:.4f} s, and {self._times.stop * 1e3:g} ms later "
                f"{side.name} has not been told",
            )
        )

    def company(self, first: Side, time: float, token: int) -> None:
        """Where one amplifier plays a set, all do, or it is silenced."""
        for side in self._sides.values():
            if side is first or not side.follower.is_enabled:
                continue
            self._due.append(
                _Duty(
                    time + self._times.together,
                    lambda side=side: (  # type: ignore[misc]
                        # Where nobody is left on the first one's wire, its watchdog silences it.
                        token in side.told
                        or not first.vibrates
                        or first.silenced_at >= time  # since when it may play another set
                        or not first.is_open
                    ),
                    "commit",
                    side,
                    f"{first.name} was told at {time:.4f} s to play set {token}, and "
                    f"{self._times.together * 1e3:g} ms later {side.name} was not",
                )
            )

    def _is_released(self, side: Side, lifted: float) -> bool:
        """Whether it was told to be silent after a lift, or has a good reason not to be."""
        is_touched_again = self._people.touched >= lifted
        told = not side.vibrates or side.follower.is_in_fault or not side.is_open
        has_given_up = side.last_life is None  # since some trouble
        return told or is_touched_again or has_given_up or self._people.hung is not None

    def _can_play(self) -> bool:
        sides = self._sides.values()
        return self._people.hung is None and all(
            side.is_open and side.follower.is_enabled and not side.is_stopped for side in sides
        )

    def _is_answered(self, contact: Hashable, since: float) -> bool:
        """Whether a pattern plays since then, or there is a good reason why none does."""
        return (
            any(side.vibrated_at >= since for side in self._sides.values())
            or contact not in (self._people.contacts or ())
            or self._people.silence_wished >= since
            or self._people.hung is not None
            or any(side.follower.is_in_fault or not side.is_open for side in self._sides.values())
        )
