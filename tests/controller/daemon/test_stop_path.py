"""The way of a stop through a daemon, from the bytes on its socket to the bytes on the wire."""

from stop_path import stop_path


def test_stop_takes_one_turn_and_few_functions() -> None:
    """Nothing waits on its way, and what it passes through can be read in a few minutes."""
    path, calls = stop_path()
    assert path[0].endswith("Connection.buffer_updated")
    assert path[-1].endswith("Line._send")
    assert len(path) < 20, path
    assert calls < 100
