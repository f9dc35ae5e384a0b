"""Sets as they were sent to an amplifier, and what it says of them."""

import math

from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import Assembly, LayerSet, unpack_layers
from drivers.protocol.table import QUANTITIES, STAGED_LIFE
from sim.witness.decoded import Request

_TURN = 36000  # of the wire; phases are modulo this
_DERATED = 0.01  # by which the shares of a derated set may differ


class SetReplies:
    """The set under way to one amplifier; times [s].

    is_exact: the set that is staged plays to the word, as the amplifier says.
    """

    def __init__(self) -> None:
        self.is_exact = True
        self._parts = Assembly()
        self._whole: tuple[int, tuple[LayerSet, ...]] = (0, ())  # token, and layers
        self._taken: set[int] = set()  # parts that have their reply
        self._taken_of = 0
        self._began = -math.inf  # of the first part, at the earliest
        self._staged = 0  # token

    def drop(self) -> None:
        """Discard what is staged."""
        self._staged, self._taken, self._taken_of = 0, set(), 0

    def sent(self, request: Request, time: float) -> str:
        """Note a part of a set that is sent; returns what is wrong with it, or ""."""
        if request.name != "Set":
            return ""
        try:
            stream = self._parts.add(request.values, time, QUANTITIES["set_words"].maximum)
            if stream is not None:
                self._whole = request.values["token"], unpack_layers(stream)
        except Refusal as refusal:
            return str(refusal)
        return ""

    def whole(self, token: int) -> tuple[LayerSet, ...] | None:
        """Return the layers of a set, all parts of which were sent."""
        return self._whole[1] if token == self._whole[0] else None

    def is_staged(self, token: object, time: float = -math.inf) -> bool:
        """Whether a set is staged, and kept until a time at least."""
        return bool(self._staged) and token == self._staged and time <= self._began + STAGED_LIFE

    def taken(
        self, part: Values, reply: Values, when: tuple[float, float], *, is_committed: bool
    ) -> str:
        """Compare the reply to a part; returns what is wrong with it. is_committed: before."""
        token = part["token"]
        if token != self._taken_of:
            self._taken, self._taken_of, self._began = set(), token, when[0]
        self._taken.add(part["index"])
        is_whole = self.whole(token) is not None
        is_kept, is_played = bool(reply["staged"]), bool(reply["played"])
        self.is_exact = bool(reply["exact"])
        self._staged = token if is_kept else 0
        problem = ""
        if (is_kept or is_played) and not is_whole:
            problem = "accepted before all of its parts"
        elif is_played != (bool(part["now"]) and is_whole) and not is_committed:
            problem = "played" if is_played else "not played"
        elif len(self._taken) == part["parts"] and not (is_kept or is_played):
            problem = "not staged, though it is whole"
        elif not (is_kept or is_played) and reply["missing"] in self._taken:
            problem = f"misses part {reply['missing']}, which it took"
        return problem if when[1] < self._began + STAGED_LIFE else ""


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
    shares: dict[int, float] = {}
    for channel, command in commands.items():
        got = played[channel]
        turned = (got["phase"] - command.phase + _TURN // 2) % _TURN - _TURN // 2
        is_same = abs(got["frequency"] - command.frequency) <= 1 and abs(turned) <= 1
        if not is_same or (abs(got["level"] - command.level) > 1 and not can_scale):
            return "plays", f"channel {channel} must play {command}, got {got}"
        if command.level:
            shares[command.level] = got["level"] / command.level
    if shares and max(shares.values()) - min(shares.values()) > _DERATED + 1 / min(shares):
        return "commit", "its channels are scaled differently"
    return None
