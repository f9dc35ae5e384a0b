from drivers.command import DriveCommand
from drivers.operation.read_back import Expectation, is_fault, read_back

COMMANDS = (DriveCommand(0, 110.0, 0.5), DriveCommand(2, 110.0, 0.2))
WANTED = (0.5, 0.0, 0.2, 0.0)
DERATED = (0.25, 0.0, 0.1, 0.0)


def after(*reports: tuple[float, tuple[float, ...]], settled_from: float = 1.0) -> Expectation:
    """The expectation after reports, each a time and levels."""
    expected = Expectation.of(COMMANDS, settled_from=settled_from)
    for now, levels in reports:
        expected = read_back(expected, levels, now)
    return expected


def test_equal_levels_are_no_fault() -> None:
    """For any time, up to a hundredth of full stroke."""
    near = (0.509, 0.009, 0.191, 0.0)
    expected = after((1.0, WANTED), (9.0, near))
    assert expected.differs_since is None
    assert not is_fault(expected, 9.0)


def test_levels_differing_for_100_ms_are_a_fault() -> None:
    """Counted from the first report that differs; one that agrees in between starts anew."""
    expected = after((2.0, DERATED), (2.05, DERATED), (2.0999, DERATED))
    assert not is_fault(expected, 2.0999)
    assert is_fault(read_back(expected, DERATED, 2.1), 2.1)
    expected = after((2.0, DERATED), (2.05, WANTED), (2.1, DERATED))
    assert not is_fault(expected, 2.15)


def test_channel_without_a_command_must_be_silent() -> None:
    """Any level differs there."""
    assert is_fault(after((2.0, (0.5, 0.3, 0.2, 0.0)), (2.2, (0.5, 0.3, 0.2, 0.0))), 2.2)


def test_ramp_is_no_fault() -> None:
    """Levels do not count before the set has settled."""
    expected = after((0.0, DERATED), (0.5, DERATED), (0.99, DERATED))
    assert not is_fault(expected, 0.99)
    assert not is_fault(read_back(expected, DERATED, 1.0), 1.0)
