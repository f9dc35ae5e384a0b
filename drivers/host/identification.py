"""Identification of an amplifier: identity, capabilities, and other devices at its address."""

import math

from drivers.errors import WrongAmplifier
from drivers.protocol.definition import QUANTITIES, VERSION, capability_ranges, has_feature
from drivers.protocol.records import Values, bits_of
from drivers.wires.wire import DuplicateAddress, OtherHost

_FULL_LEVEL = ("motion of a stiff source", "output of a linear amplifier")


class AmplifierIdentification:
    """What an amplifier has reported about itself in its replies to Hello and GetCaps.

    name: of the amplifier, for messages. place: its address and line, for messages. serial_number:
    the expected one; None for any.
    """

    is_complete: bool = False
    """Whether it is known to be the expected amplifier, with these capabilities.

    No status confirms silence before: it may be of another amplifier, or lack channels.
    """
    identity: Values
    """Values of its identity record, as read last; empty before."""
    capabilities: Values
    """Values of its capabilities record, as read last; empty before."""
    _serial_number: str | None
    """Expected serial number, or the one that it had when it was first identified."""
    is_output: bool | None
    """Expected meaning of full level; see `Amplifier`."""
    _are_several: bool = False
    """Whether two amplifiers have replied since this was reset."""
    _other_host_at: float = -math.inf
    """When another host was heard last [s]."""

    def __init__(
        self, name: str, place: str, *, serial_number: str | None, is_output: bool | None
    ) -> None:
        self.identity = {}
        self.capabilities = {}
        self._serial_number = serial_number
        self._name = name
        self._place = place
        self.is_output = is_output

    def forget(self) -> None:
        """Let no status confirm silence until the amplifier is identified again."""
        self.is_complete = False

    def expect_one(self) -> None:
        """Expect a single reply to the next Hello."""
        self._are_several = False

    def check_alone(self) -> None:
        """Raise LinkError if several amplifiers replied: the silence of one proves nothing."""
        if self._are_several:
            self.forget()
            raise WrongAmplifier(
                f"amplifier {self._name}: several amplifiers reply at {self._place}; give each its "
                "own: era amp address --serial-number"
            )

    def check_identity(self, identity: Values) -> None:
        """Raise LinkError for another amplifier, or another version; no status counts then."""
        was_complete = self.is_complete
        self.forget()
        if not identity["versions"] >> VERSION & 1:  # bit n: version n
            spoken = map(str, bits_of(identity["versions"]))
            raise WrongAmplifier(
                f"amplifier {self._name} speaks protocol {', '.join(spoken) or 'none'}, needs "
                f"{VERSION}; update it"
            )
        serial_number = identity["serial_number"]
        if self._serial_number not in (None, serial_number):
            raise WrongAmplifier(
                f"amplifier {self._name}: serial number must be {self._serial_number}, got "
                f"{serial_number}; connect the expected amplifier, or restart with this one"
            )
        self.is_complete = was_complete

    def check_capabilities(self, capabilities: Values) -> None:
        """Raise LinkError for capabilities that cannot be, or that contradict the rig."""
        for name, low, stated, high in capability_ranges(capabilities):
            if not low <= stated <= high:
                raise WrongAmplifier(
                    f"amplifier {self._name}: {name} must be {low} to {high}, got {stated}"
                )
        is_output = self.is_output
        has_output = has_feature(capabilities, "output")
        if is_output is not None and has_output is not is_output:
            raise WrongAmplifier(
                f"amplifier {self._name}: full level must be {_FULL_LEVEL[is_output]} as in the "
                f"rig file, got {_FULL_LEVEL[has_output]}; correct the rig file, or connect "
                "another amplifier"
            )

    def has_same(self, capabilities: Values) -> bool:
        """Whether it is identified and has these capabilities."""
        return self.is_complete and capabilities == self.capabilities

    def complete(self, identity: Values, capabilities: Values) -> None:
        """Note the records of the expected amplifier, after they were checked."""
        self.identity = identity
        self.capabilities = capabilities
        self._serial_number = identity["serial_number"]
        self.is_complete = True

    def note_other(self, arrival: OtherHost | DuplicateAddress, now: float) -> None:
        """Note a message, received now [s], of another host or a second amplifier."""
        if isinstance(arrival, OtherHost):
            self._other_host_at = now
        else:
            self._are_several = True

    def check_other_host(self, now: float) -> None:
        """Raise LinkError if another host was heard within the longest time of a watchdog."""
        if now - self._other_host_at <= QUANTITIES["watchdog"].high:
            raise driven_by_another(self._name)


def driven_by_another(name: str) -> WrongAmplifier:
    """Return the error of an amplifier that another host drives."""
    return WrongAmplifier(f"amplifier {name} is driven by another host; end that one first")
