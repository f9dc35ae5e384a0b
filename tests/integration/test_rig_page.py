"""The page of a rig: its content, its bytes, and how a browser shows and prints it.

The paper's plate, with an exactly known thickness, of which `era config check` warns.
"""

import base64
import filecmp
import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import era_haptics as era
from controller.cli.config_cli import app as config_commands
from era_haptics.command import run_era
from kit.plates import write_rig
from processes.gateways import Page

pytestmark = pytest.mark.asyncio(loop_scope="module")

NAME = "plate <1> & 2.yaml"
SENSORS = {"P1": (0.1, 0.05), "P2": (0.25, 0.2)}
FINGERS = [(0.3 * 0.3048, 0.35 * 0.2286), (0.8 * 0.3048, 0.6 * 0.2286)]


def write_paper_rig(folder: Path) -> Path:
    """Write the rig into a new folder."""
    folder.mkdir()
    warned = ("  level: 1.0", "  level: 1.0\nuncertainty: {thickness: 0}")
    few_frequencies = ("[40 Hz, 500 Hz]", "[40 Hz, 250 Hz]")
    return write_rig(folder / NAME, warned, few_frequencies)


@pytest.fixture(scope="module")
def rig_file(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The rig, with tables in a cache of the module."""
    folder = tmp_path_factory.mktemp("page")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        yield write_paper_rig(folder / "first")


@pytest.fixture(scope="module")
def page_file(rig_file: Path) -> Path:
    """Its page from Python, with two sensors."""
    path = rig_file.with_name("page.html")
    era.page(era.load_rig(rig_file), path, sensors=SENSORS)
    return path


async def texts(tab: Page, selector: str) -> list[str]:
    """Return the text of each element of a selector."""
    found = f"[...document.querySelectorAll({json.dumps(selector)})]"
    return list(await tab.evaluate(f"{found}.map(e => e.textContent)"))


async def test_equal_rigs_have_pages_of_equal_bytes(page_file: Path, tmp_path: Path) -> None:
    """By the command in another folder, under another name, from a table in the cache."""
    copy = write_paper_rig(tmp_path / "second")
    sensors = tmp_path / "sensors.csv"
    rows = [f"{name},{x},{y}" for name, (x, y) in SENSORS.items()]
    sensors.write_text("\n".join(["sensor,x_m,y_m", *rows]))
    output = tmp_path / "other.html"

    assert run_era(["plate", "page", str(copy), "--sensors", str(sensors), "-o", str(output)]) == 0

    assert filecmp.cmp(output, page_file, shallow=False)


async def test_browser_shows_the_page_without_requests_or_complaints(
    tab: Page, page_file: Path
) -> None:
    """One file; the rig's name as it is, not as tags."""
    await tab.show(page_file.as_uri())

    assert await tab.evaluate("performance.getEntriesByType('resource').length") == 0
    assert tab.complaints == []
    assert NAME in (await texts(tab, "header p"))[0]
    (command,) = await texts(tab, "footer code")
    arguments = ["'plate <1> & 2.yaml'", "--sensors SENSORS.csv", "-o 'plate <1> & 2.html'"]
    assert command == " ".join(["era plate page", *arguments])


async def test_page_prints_on_three_sheets_to_scale(tab: Page, page_file: Path) -> None:
    """By hand, 304.8 mm at 1 : 4 are 76.2 mm, and 288 pixels of 1/96 inch."""
    await tab.show(page_file.as_uri())
    reply = await tab.call("Page.printToPDF", preferCSSPageSize=True, printBackground=True)
    sheets = re.findall(rb"/Type\s*/Page\b", base64.b64decode(reply["data"]))
    await tab.call("Emulation.setEmulatedMedia", media="print")

    assert len(sheets) == 3
    assert "1 : 4" in await texts(tab, ".scaled svg text")
    box = "document.querySelector('.scaled svg path[style*=\"--fill\"]').getBoundingClientRect()"
    size = await tab.evaluate(f"[{box}.width, {box}.height]")
    np.testing.assert_allclose(size, [288, 216], atol=1.5)


async def test_page_is_dark_on_a_dark_screen(tab: Page, page_file: Path) -> None:
    """Light text on a dark background, in drawings too."""
    await tab.show(page_file.as_uri())
    await tab.dark(True)

    for element in ("document.body", "document.querySelector('.scaled svg text')"):
        color = await tab.evaluate(f"getComputedStyle({element}).getPropertyValue('color')")
        assert min(map(int, re.findall(r"\d+", color))) > 150, element
    background = await tab.evaluate("getComputedStyle(document.body).backgroundColor")
    assert max(map(int, re.findall(r"\d+", background))) < 60


async def test_page_repeats_what_other_commands_print(
    tab: Page, page_file: Path, rig_file: Path
) -> None:
    """Parts with their channels, modes, findings, and promised contrasts of three vibrations."""
    await tab.show(page_file.as_uri())
    rig = era.load_rig(rig_file)

    drawn = await texts(tab, ".scaled svg text")
    assert {"SW", "SE", "NE", "NW", "P1", "P2", "304.8 mm", "228.6 mm"} <= {*drawn}
    assert "main 0main 1main 2main 3" in "".join(await texts(tab, ".wiring td:last-child"))
    modes = era.SolvedPlate(rig).modes
    frequencies = await texts(tab, ".modes td:nth-child(2)")
    assert frequencies == [f"{frequency:.1f} Hz" for frequency in modes.natural_frequencies]
    ratios = await texts(tab, ".modes td:nth-child(3)")
    assert ratios == [f"{100 * ratio:.1f} %" for ratio in modes.damping_ratios]
    check = CliRunner().invoke(config_commands, ["config", "check", str(rig_file), "--json"])
    warnings = json.loads(check.stdout)["warnings"]
    assert len(warnings) == 1
    assert await texts(tab, "li") == warnings
    fingers = [era.Finger(at, era.Stimulus()) for at in (*FINGERS, (0.45 * 0.3048, 0.85 * 0.2286))]
    answer = era.answer(era.table(rig), fingers)
    contrasts = [f"{finger.promised_contrast_db:.0f} dB above" for finger in answer.fingers]
    labels = " ".join(await texts(tab, "svg text"))
    assert all(contrast in labels for contrast in contrasts)
