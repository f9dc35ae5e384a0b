"""Sets of a rig and their tokens."""

from pathlib import Path

import pytest

from controller.loop import safe_sets
from controller.loop.safe_sets import SafeSets, SetBuilder
from drivers.guard import Guard, GuardLimits
from drivers.protocol.definition import is_newer_token
from model.rig.file import load_rig
from rig_files import write_rig
from sim.amplifier.amplifier import capabilities


@pytest.mark.parametrize("is_shaped", [False, True])
@pytest.mark.parametrize("first", [65510, 65511])
def test_silence_before_a_set_has_an_older_token(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, first: int, is_shaped: bool
) -> None:
    """Older than both forms of a set that has two, newer than the set before; past 65535."""
    monkeypatch.setattr(safe_sets, "random_token", lambda: first)
    guards = {"main": Guard(GuardLimits(40.0, 500.0, 1.0), capabilities(4))}
    builder = SetBuilder(load_rig(write_rig(tmp_path / "rig.yaml")), guards, timing=None)
    for _ in range(10):
        earlier = builder.build_silence(ramp=0.01)
        plain = builder.build_silence(ramp=0.01)
        shaped = SafeSets(builder.build_silence(ramp=0.01).sets, plain=plain)
        wanted = shaped if is_shaped else plain
        silence = builder.build_silence(ramp=0.01, before=wanted)
        assert is_newer_token(silence.token, earlier.token)
        assert is_newer_token(plain.token, silence.token)
        assert not is_shaped or is_newer_token(shaped.token, plain.token)
