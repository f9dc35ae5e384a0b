"""Fixtures of the gateway's tests."""

from collections.abc import Iterator

import pytest

from processes.gateways import ScriptedDaemon


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ScriptedDaemon]:
    """A daemon that records its calls, for all tests of a module."""
    with ScriptedDaemon(tmp_path_factory.mktemp("daemon")) as scripted:
        yield scripted
