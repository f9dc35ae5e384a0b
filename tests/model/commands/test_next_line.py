import os

import pytest

from model.commands.options import next_line


@pytest.mark.parametrize(
    ("system", "line"),
    [
        ("posix", "Next: era table show 'my $plates/t.npz' --weak"),
        ("nt", 'Next: era table show "my $plates/t.npz" --weak'),
    ],
)
def test_next_line_is_for_the_shell(
    monkeypatch: pytest.MonkeyPatch, system: str, line: str
) -> None:
    """A name with a space is one word to the shells of Unix, and to those of Windows."""
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(os, "name", system)
        said = next_line("era", "table", "show", "my $plates/t.npz", "--weak")
    assert said == line
