"""Questions to the table from the command line and from Python."""

import errno
import json
import re
from unittest.mock import Mock

import pytest
from typer.testing import CliRunner

from model.answer.answer_report import query_batch
from model.answer.stimulus import Placement
from model.cli import app
from model.commands.table_cli import query
from model.errors import InputError
from model.table.table_file import save_table
from plates import smooth_table
from set_table import only

RUNNER = CliRunner()


@pytest.fixture(scope="module")
def table_file(tmp_path_factory):
    """The table on disk."""
    path = tmp_path_factory.mktemp("tables") / "t.npz"
    save_table(smooth_table(), path)
    return path


def test_a_line_of_a_batch_is_read_key_by_key():
    """Targets, quiet fingers, mode, level and loads."""
    line = (
        '{"targets": [[0.1, 0.1], [0.2, 0.2]], "quiet": [[0.05, 0.02]], "mode": "switched",'
        ' "level_db_sl": 15, "loads": [1, 2, 0.5]}'
    )
    (found,) = query_batch(smooth_table(), [line])
    placed = Placement(((0.1, 0.1), (0.2, 0.2)), ((0.05, 0.02),), (1.0, 2.0, 0.5))
    layer, felt = only(smooth_table(), placed, 15.0, drive_mode="switched")
    assert found["layers"][0]["drive"] == smooth_table().drive_of(layer.excitation)
    assert found["layers"][0]["fingers"] == [0, 1]
    assert found["fingers"][0]["promised_contrast_db"] == felt.promised_contrast_db


BAD_LINES = {
    "nonsense": r'such as \{"target".*Invalid JSON',
    "[]": r'such as \{"target".*object',
    '{"target": [0.1]}': "target",
    '{"target": [0.1, 0.1], "loud": 3}': "loud",
    '{"target": [0.1, "x"]}': "target.1",
    '{"target": [0.1, 0.1], "targets": [[0.2, 0.1]]}': "target must be given without targets",
    "{}": "at least one finger",
}


def test_a_bad_line_of_a_batch_is_refused():
    """The key that is wrong is named."""
    found = list(query_batch(smooth_table(), BAD_LINES))
    for number, (answer, named) in enumerate(zip(found, BAD_LINES.values(), strict=True), start=1):
        assert answer["line"] == number
        assert re.search(named, answer["error"])


@pytest.mark.parametrize("has_errors", [True, False])
def test_batch_answers_line_by_line(table_file, tmp_path, has_errors):
    """An error has its line's number and makes status 1; empty lines are skipped."""
    batch = tmp_path / "b.jsonl"
    good = '{"target": [0.1, 0.1], "quiet": [[0.2, 0.15]], "mode": "phased"}\n\n'
    batch.write_text(good * 2 + 'oops\n{"target": [9, 9]}\n' * has_errors)
    result = RUNNER.invoke(app, ["table", "query", str(table_file), "--batch", str(batch)])
    assert result.exit_code == has_errors
    first, second, *errors = map(json.loads, result.stdout.splitlines())
    assert first["layers"][0]["mode"] == second["layers"][0]["mode"] == "phased"
    assert [each["line"] for each in errors] == [5, 6][: len(errors)]
    assert all("error" in each for each in errors)
    assert len(errors) == 2 * has_errors


def test_batch_reads_standard_input(table_file):
    """`-` is no file of that name: what another program writes is answered."""
    line = '{"target": [0.1, 0.1], "mode": "phased"}\n'
    result = RUNNER.invoke(app, ["table", "query", str(table_file), "--batch", "-"], input=line)
    assert result.exit_code == 0
    assert json.loads(result.stdout)["layers"][0]["mode"] == "phased"


def test_batch_is_not_blamed_where_its_reader_closes(table_file, tmp_path, monkeypatch):
    """As in `era table query TABLE --batch FILE | head`: the error is of the answers' pipe."""
    batch = tmp_path / "b.jsonl"
    batch.write_text('{"target": [0.1, 0.1]}\n')
    broken = Mock(side_effect=BrokenPipeError(errno.EPIPE, "Broken pipe"))
    monkeypatch.setattr("builtins.print", broken)
    with pytest.raises(BrokenPipeError):
        query(table_file, batch=batch)


def test_batch_takes_options_as_defaults_of_its_lines(table_file, tmp_path):
    """Level, mode and envelopes of the command hold where a line leaves them out."""
    batch = tmp_path / "b.jsonl"
    place = '"target": [0.1, 0.1], "quiet": [[0.2, 0.15]]'
    own = '"mode": "switched", "level_db_sl": 9, "envelopes": false'
    batch.write_text("{" + place + "}\n{" + place + ", " + own + "}\n")
    options = "--level 14 --mode phased --envelopes"
    command = ["table", "query", str(table_file), "--batch", str(batch), *options.split()]
    result = RUNNER.invoke(app, command)
    default, given = map(json.loads, result.stdout.splitlines())
    for found, level in ((default, 14.0), (given, 9.0)):
        assert found["fingers"][0]["promised_level_db_sl"] == pytest.approx(level)
    (shaped,), (plain,) = default["layers"], given["layers"]
    assert (shaped["mode"], plain["mode"]) == ("phased", "switched")
    assert shaped["onset"] is not None
    assert plain["onset"] is None


def test_batch_refuses_a_file_that_is_not_utf_8(table_file, tmp_path):
    """The error names the option."""
    (tmp_path / "b.jsonl").write_bytes(b"\xff\xfe")
    command = ["table", "query", str(table_file), "--batch", str(tmp_path / "b.jsonl")]
    result = RUNNER.invoke(app, command)
    assert isinstance(result.exception, InputError)
    assert "--batch" in str(result.exception)
