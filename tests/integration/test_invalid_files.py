"""Files that are no plain data: a daemon refuses them, at its start and on a reload."""

import os
import pickle
import random
from pathlib import Path

import pytest

from cases import shortly
from controller.daemon.daemon import check_daemon
from kit.clock import in_virtual_time
from model.errors import InputError
from processes.daemons import (
    ENABLED,
    holding,
    ready_daemon,
)


class Opened:
    """Runs a command when it is unpickled."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("touch pickled",)


BOMB = "\n".join(
    ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    + [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 12)]
)
LAYOUT = """effects: {hum: {kind: buzz}}
regions:
  pad: {rectangle: {start: [1 cm, 1 cm], end: [20 cm, 18 cm]}, on_press: hum}
"""

INVALID = [
    pytest.param(b"", "", id="empty"),
    pytest.param(pickle.dumps({"rig": Opened()}), "", id="pickle"),
    pytest.param(BOMB.encode(), ":1: a0: ", id="aliases"),
    pytest.param(b"x: !!python/object/apply:os.system ['touch pickled']\n", ":1: x: ", id="tag"),
    pytest.param(b"a: " + b"[" * 900, ":1: a", id="nested"),
    pytest.param(b"a: 1\n" + b"#" * (1 << 22), "", id="large"),
    pytest.param(b"a: 1\na: 2\n", ":2: a: ", id="duplicate key"),
    pytest.param(random.Random(5).randbytes(3000), "", id="noise"),
    pytest.param(None, "", id="endless device"),
]


@pytest.mark.parametrize("is_every_one", shortly([False, True], [False]))
@in_virtual_time
async def test_running_daemon_keeps_configuration_when_reload_is_invalid(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, is_every_one: bool
) -> None:
    """Each invalid file: nothing is applied, not even valid changes beside it; it plays on."""
    layout, config = tmp_path / "layout.yaml", tmp_path / "daemon.yaml"
    layout.write_text(LAYOUT, encoding="utf-8")
    async with ready_daemon(tmp_path, "layouts: {panel: layout.yaml}\n") as (bench, era):
        await era.arm("test", lease_s=60)
        effects = await era.effects()
        async with holding(era, far=bench.far):
            good = config.read_text("utf-8")
            config.write_text(f"{good}dashboard: 127.0.0.1:1\n", encoding="utf-8")
            invalid = [case.values[0] for case in INVALID if case.values[0] is not None]
            invalid = invalid[:: 1 if is_every_one else 3]
            for content in invalid:
                layout.write_bytes(content)
                await bench.daemon.reload()
            rejected = [message for message in caplog.messages if "reload rejected" in message]
            assert len(rejected) == len(invalid)
            assert "reload failed" not in caplog.text
            assert await era.effects() == effects
            assert max(bench.far.summary().levels) > 0
        status = await era.status()
        assert status.state == ENABLED
        assert (status.lease_left_s or 0) > 5
    with pytest.raises(InputError, match=r"layout\.yaml"):
        check_daemon(config)
