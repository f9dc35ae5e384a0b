"""Sets as they were sent to an amplifier, and what it says of them."""

import math

from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import Assembly, LayerSet, unpack_layers
from drivers.protocol.table import QUANTITIES, STAGED_LIFE
from sim.witness.violation import ReportViolation

_TURN = 36000  # of the wire; phases are modulo this
_DERATED = 0.01  # by which the shares of a derated set may differ


class SetReplies:
    """The set under way to one amplifier by name; times [s].

    is_exact: the set that is staged plays to the word, as the amplifier says.
    """

    def __init__(self, name: str, *, report: ReportViolation) -> None:
        self.is_exact = True
        self._name = name
        self._report = report
        self._parts = Assembly()
        self._whole: dict[int, tuple[LayerSet, ...]] = {}  # by token: the last one
        self._taken: set[int] = set()  # parts that have their reply
        self._taken_of = 0
        self._began = -math.inf  # of the first part, at the earliest
        self._staged = 0  # token

    def drop(self) -> None:
        """Discard what is staged."""
        self._staged, self._taken, self._taken_of = 0, set(), 0

    def sent(self, part: Values, time: float) -> tuple[tuple[LayerSet, ...] | None, str]:
        """Note a part that is sent; the layers once all were, and what is wrong with them."""
        try:
            stream = self._parts.add(part, time, QUANTITIES["set_words"].maximum)
            if stream is None:
                return None, ""
            layers = unpack_layers(stream)
        except Refusal as refusal:
            return None, str(refusal)
        self._whole = {part["token"]: layers}
        return layers, ""

    def whole(self, token: int) -> tuple[LayerSet, ...] | None:
        """Return the layers of a set, all parts of which were sent."""
        return self._whole.get(token)

    def is_staged(self, token: object, time: float = -math.inf) -> bool:
        """Whether a set is staged, and kept until a time at least."""
        return bool(self._staged) and token == self._staged and time <= self._began + STAGED_LIFE

    def taken(
        self,
        part: Values,
        reply: Values,
        when: tuple[float, float],
        *,
        is_committed: bool,
        is_fine: bool,
    ) -> tuple[LayerSet, ...] | None:
        """Compare the reply to a part; returns the layers of a set that plays from now on.

        is_committed: it was before; is_fine: no reason is known why it would not be exact.
        """
        token, end = part["token"], when[1]
        if reply["token"] != token:
            what = f"{self._name}: reply to set {token} reports set {reply['token']}"
            self._report("credit", end, what)
            return None
        if token != self._taken_of:
            self._taken, self._taken_of, self._began = set(), token, when[0]
        self._taken.add(part["index"])
        layers = self._whole.get(token)
        is_kept, is_played = bool(reply["staged"]), bool(reply["played"])
        problem = ""
        if (is_kept or is_played) and layers is None:
            problem = "accepted it before all of its parts"
        elif is_played != (bool(part["now"]) and layers is not None) and not is_committed:
            problem = "played it" if is_played else "did not play it"
        elif len(self._taken) == part["parts"] and not (is_kept or is_played):
            problem = "has not staged it, though it is whole"
        elif not (is_kept or is_played) and reply["missing"] in self._taken:
            problem = f"misses part {reply['missing']}, which it took"
        if problem and end < self._began + STAGED_LIFE:
            self._report("commit", end, f"{self._name}: set {token}: {problem}")
        if (is_kept or is_played) and is_fine and not reply["exact"]:
            self._report("plays", end, f"{self._name} does not play set {token} exactly")
        self.is_exact = bool(reply["exact"])
        self._staged = token if is_kept else 0
        return layers if is_played else None


def achieved_problem(
    expected: LayerSet, token: int, reply: Values, *, can_scale: bool
) -> tuple[str, str] | None:
    """Return the rule that a reply to GetAchieved breaks, and how; None if it agrees.

    can_scale: all levels may be lower by one factor.
    """
    if reply["token"] != token:
        return "token", f"token must be {token}, got {reply['token']}"
    played = {each["channel"]: each for each in reply["commands"]}
    commands = {each.channel: each for each in expected.commands}
    if played.keys() != commands.keys():
        return "commit", f"channels must be {sorted(commands)}, got {sorted(played)}"
    shares = []
    for channel, command in commands.items():
        got = played[channel]
        turned = (got["phase"] - command.phase + _TURN // 2) % _TURN - _TURN // 2
        is_same = abs(got["frequency"] - command.frequency) <= 1 and abs(turned) <= 1
        if not is_same or (abs(got["level"] - command.level) > 1 and not can_scale):
            must = _listed(command.frequency, command.level, command.phase)
            plays = _listed(got["frequency"], got["level"], got["phase"])
            return "plays", f"channel {channel} must play {must}, got {plays}"
        if command.level:
            shares.append(got["level"] / command.level)
    if shares and max(shares) - min(shares) > _DERATED + 1 / min(
        each.level for each in commands.values() if each.level
    ):
        return "commit", "its channels are scaled differently"
    return None


def _listed(frequency: int, level: int, phase: int) -> str:
    return f"frequency {frequency}, level {level}, phase {phase}"
