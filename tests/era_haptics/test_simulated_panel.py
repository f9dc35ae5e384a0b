"""A simulated panel: what fingers on its plate feel, and when its time passes."""

import asyncio
from pathlib import Path

import pytest

import era_haptics as era

TARGET, OTHER = (0.08, 0.06), (0.22, 0.16)
STEADY = [(0, 1, 0.5), (1, 1, 0.5)]


@pytest.fixture
def rig(table_cache: Path, monkeypatch: pytest.MonkeyPatch) -> era.Rig:
    """The example's rig, whose table is cached."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(table_cache))
    return era.load_rig(era.example_rig_path())


def test_fingers_feel_what_play_has_returned(rig: era.Rig) -> None:
    """On the rig's own plate: the predicted level, and less than the promised crosstalk."""
    with era.simulated_panel(rig) as panel:
        client = panel.client
        with client.resting([TARGET, OTHER]), client.armed("test"):
            played = client.play(STEADY, TARGET, level_db_sl=14)
            assert (played.outcome, played.start_s is not None) == ("played", True)
            start = played.start_s or 0.0
            client.sleep(1.0)
            own, other = panel.felt(start + 0.5, start + 0.9)

    assert own.level_db_sl == pytest.approx(played.level_db_sl, abs=1.0)
    (crosstalk,) = played.other_fingers
    assert other.loudest_db_sl <= (crosstalk.rig_foreign_level_db_sl or 0)
    with pytest.raises(era.Unreachable):
        client.status()


def test_time_of_a_panel_passes_only_during_calls(rig: era.Rig) -> None:
    """In an event loop of a notebook, too: `sleep` passes its time, nothing else does."""

    async def use() -> list[float]:
        with era.simulated_panel(rig, seed=1) as panel:
            times = [panel.client.status().time_s]
            panel.client.sleep(100.0)
            times.append(panel.client.status().time_s)
            era.answer(era.table(rig), [era.Finger(TARGET, era.Stimulus())])  # takes real time
            times.append(panel.client.status().time_s)
        return times

    start, slept, computed = asyncio.run(use())

    assert slept - start == pytest.approx(100.0, abs=0.01)
    assert computed - slept == pytest.approx(0.0, abs=0.01)
