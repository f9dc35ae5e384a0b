"""Questions as JSON lines, and `era table query`."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from model.cli import app
from model.errors import InputError
from model.table.file import save_table
from model.table.query import query_batch, question_from_json
from paper_table import smooth_table

RUNNER = CliRunner()


@pytest.fixture(scope="module")
def table_file(tmp_path_factory):
    """The table on disk."""
    path = tmp_path_factory.mktemp("tables") / "t.npz"
    save_table(smooth_table(), path)
    return path


def test_a_line_is_a_question():
    """Every key of a line ends up where it belongs."""
    question = question_from_json(
        '{"targets": [[0.1, 0.1], [0.2, 0.2]], "quiet": [[0.05, 0.02]], "mode": "phased",'
        ' "level_db_sl": 15, "eras_at_most": 3}'
    )
    assert question.targets == ((0.1, 0.1), (0.2, 0.2))
    assert question.quiet == ((0.05, 0.02),)
    assert (question.drive_mode, question.level_db_sl, question.eras_at_most) == ("phased", 15.0, 3)
    assert question_from_json('{"target": [0.1, 0.1]}').targets == ((0.1, 0.1),)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("nonsense", r'such as \{"target".*Invalid JSON'),
        ("[]", r'such as \{"target".*object'),
        ('{"target": [0.1]}', "target"),
        ('{"target": [0.1, 0.1], "loud": 3}', "loud"),
        ('{"target": [0.1, "x"]}', "target.1"),
        ("{}", "at least one target"),
    ],
)
def test_lines_that_are_no_question_say_why(line, says):
    """The key that is wrong is named."""
    with pytest.raises(InputError, match=says):
        question_from_json(line)


def test_the_questions_on_the_page_are_questions():
    """Whoever types what the page of commands shows has an answer to each line."""
    page = (Path(__file__).parents[3] / "docs/reference/commands.md").read_text(encoding="utf-8")
    block = page.split("```json\n")[1].split("```")[0]
    first, second = [question_from_json(line) for line in block.splitlines()]
    assert (first.targets, first.quiet) == (((0.08, 0.06),), ((0.22, 0.16),))
    assert (len(second.targets), second.level_db_sl, second.drive_mode) == (2, 15.0, "signed")


def test_a_bad_line_does_not_end_the_run():
    """Each line has its answer; one without says its number; empty lines are passed over."""
    lines = ['{"target": [0.1, 0.1]}\n', "\n", "oops\n", '{"target": [9, 9]}\n']
    first, bad, off = query_batch(smooth_table(), lines)
    assert first["level_db_sl"] == 20.0
    assert (bad["line"], off["line"]) == (3, 4)
    assert "(9, 9)" in off["error"]


def test_a_batch_answers_line_by_line_and_exits_with_one_if_a_line_failed(table_file, tmp_path):
    """Status 1 with a bad line among them, 0 without; answers are JSON lines."""
    batch = tmp_path / "b.jsonl"
    good = '{"target": [0.1, 0.1], "quiet": [[0.2, 0.15]], "mode": "phased"}\n'
    for content, status in ((good * 2, 0), (good + "oops\n", 1)):
        batch.write_text(content)
        result = RUNNER.invoke(app, ["table", "query", str(table_file), "--batch", str(batch)])
        assert result.exit_code == status
        first, second = map(json.loads, result.stdout.splitlines())
        assert first["mode"] == "phased"
        assert ("error" in second) == (status == 1)


def test_a_query_has_all_measures(table_file):
    """The keys that scripts rely on, and figures that fit each other."""
    options = "--target 0.09,0.07 --quiet 0.25,0.18 --mode signed --level 18 --json"
    result = RUNNER.invoke(app, ["table", "query", str(table_file), *options.split()])
    answer = json.loads(result.stdout)
    assert answer["mode"] == "signed"
    assert answer["level_db_sl"] == 18.0
    assert answer["robust_contrast_db"] < answer["contrast_db"]
    assert answer["contrast_db_sl"] == pytest.approx(18.0 - answer["quiet_level_db_sl"])
    assert answer["quiet_is_unaware"] == (answer["quiet_level_db_sl"] <= -10)
    assert answer["solve_time_s"] > 0
    for tone in answer["drive"].values():
        assert 0 < tone["level"] <= 1
        assert min(abs(tone["phase_deg"]), abs(abs(tone["phase_deg"]) - 180)) < 1e-3
    assert "transient_contrast_db" in answer


def test_more_eras_and_several_targets_can_be_asked_for(table_file):
    """`--eras 4` is at least as good as two; two `--target` are both taken."""
    contacts = ["--target", "0.09,0.07", "--quiet", "0.25,0.18", "--quiet", "0.2,0.05"]
    command = ["table", "query", str(table_file), *contacts, "--json"]
    two, four = (
        json.loads(RUNNER.invoke(app, [*command, *more]).stdout) for more in ([], ["--eras", "4"])
    )
    assert four["contrast_db"] >= two["contrast_db"] - 1e-4
    both = json.loads(RUNNER.invoke(app, [*command, "--target", "0.15,0.2"]).stdout)
    assert both["contrast_db"] <= two["contrast_db"] + 1e-4
