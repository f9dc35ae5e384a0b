"""`era figure`: pictures and CSV files in a folder."""

import csv
import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from era_haptics.lab.paper_figures import figure_app
from model.rig.rig_file import example_rig_path

pytestmark = pytest.mark.usefixtures("plain_pictures")

RUNNER = CliRunner()
RIG = str(example_rig_path())
PNG = b"\x89PNG\r\n\x1a\n"


def test_figure_writes_a_picture_and_its_numbers(tmp_path: Path) -> None:
    """Figure 7 as PNG and CSV in a new folder, and what is printed of them."""
    folder = tmp_path / "new" / "figures"
    result = RUNNER.invoke(figure_app, ["7", RIG, "-o", str(folder), "--mesh", "12x9", "--json"])
    assert result.exit_code == 0
    assert sorted(path.name for path in folder.iterdir()) == [
        "figure_7.csv",
        "figure_7.png",
        "figure_7_shapes.csv",
    ]
    assert (folder / "figure_7.png").read_bytes().startswith(PNG)
    with (folder / "figure_7.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    # Table 2 of the paper, on its mesh.
    assert [f"{float(row['model_hz']):.2f}" for row in rows] == [
        "31.98", "68.50", "76.62", "107.84", "160.77",
    ]  # fmt: skip
    answer = json.loads(result.stdout)
    assert "figure_7" in answer["figures"]
    assert all(Path(name).is_file() for name in answer["files"])
    assert len(answer["files"]) == 3
