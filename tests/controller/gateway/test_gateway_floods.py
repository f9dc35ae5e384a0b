"""A stop of a fresh client gets through while others attack the whole gateway over TLS."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway_attacks import ATTACKS, LIMIT, attack, attacked_gateway
from gateway_bench import GatewayProcess, real_daemon
from long_form import shortly

pytestmark = [pytest.mark.real_time, pytest.mark.alone]

SHORT = (
    "600 half handshakes",
    "8 WebSockets, texts of 2 bytes",
    "300 slow heads, a byte per 0.5 s",
)
MAX_MEMORY = 150.0  # MB; with handshakes that never end
MAX_GROWTH = 400.0  # MB; a storm of TLS connections is garbage for a while


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The socket of a real daemon for all attacks."""
    with real_daemon(tmp_path_factory.mktemp("daemon")) as path:
        yield path


@pytest.fixture
def attacked(daemon: Path, tmp_path: Path) -> Iterator[tuple[GatewayProcess, Path]]:
    """A gateway over TLS, which logs nothing, and its certificate."""
    with attacked_gateway(tmp_path, daemon) as (gateway, certificate):
        yield gateway, certificate
        assert gateway.log() == ""


@pytest.mark.parametrize("name", shortly(ATTACKS, SHORT))
def test_stops_get_through_an_attack(attacked: tuple[GatewayProcess, Path], name: str) -> None:
    """Each is carried out, and the gateway takes less than half a second of a processor meanwhile.

    Other programs do not lengthen that, unlike the duration on a busy machine.
    """
    gateway, certificate = attacked
    outcome = attack(gateway, name, certificate, seconds=6.0)
    print(outcome.row(name))  # noqa: T201 (with -s it is the table)
    assert len(outcome.stops) >= 5
    assert all(each.is_done for each in outcome.stops)
    assert max(each.processor for each in outcome.stops) < LIMIT
    grown = outcome.memory_most - outcome.memory_before
    assert grown < MAX_GROWTH
    assert "handshake" not in name or outcome.memory_most < MAX_MEMORY
