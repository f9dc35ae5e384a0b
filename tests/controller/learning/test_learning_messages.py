"""Messages between a daemon and its estimator."""

import pickle

import pytest

from controller.learning.messages import HEAD, Note, packed, unpacked
from drivers.contents import Layer, Tone


def test_message_has_its_length_before_it() -> None:
    """Eight bytes, the largest first; then what it is made of again."""
    message = packed(Note("the plate settles", is_final=True))
    assert int.from_bytes(message[:HEAD], "big") == len(message) - HEAD
    assert unpacked(message[HEAD:]) == Note("the plate settles", is_final=True)


def test_no_command_comes_by_a_message() -> None:
    """What an amplifier could play is refused, wherever it stands in it."""
    layer = Layer(0, (Tone(0, 110.0, 1.0),))
    with pytest.raises(pickle.UnpicklingError, match="drivers"):
        unpacked(pickle.dumps(Note([layer])))  # type: ignore[arg-type]
