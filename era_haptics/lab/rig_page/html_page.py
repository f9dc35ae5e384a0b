"""The page of a rig: one file of HTML that needs no network and prints on three sheets of A4.

Equal rigs give equal bytes: the page contains neither dates nor folders.
"""

import shlex
from collections.abc import Mapping
from html import escape
from importlib import resources
from os import PathLike
from pathlib import PurePath
from string import Template

from matplotlib import style

from era_haptics.drive import as_points
from era_haptics.lab.rig_page import page_pictures, page_sections
from era_haptics.lab.rig_page.page_sections import html_of, table_rows
from era_haptics.lab.rig_page.page_style import STYLE, svg_of
from era_haptics.lab.rig_page.plate_drawing import drawing_picture
from era_haptics.lab.rig_page.rig_report import RigReport, report_of
from model.answer.answer import MIN_CONTRAST_DB, OWN_CONTRAST_DB
from model.answer.stimulus import check_on_plate
from model.arrays import FloatArray, Point
from model.caching import code_version
from model.errors import InputError, expect_instance, expect_path
from model.files.array_file import whole_or_nothing
from model.files.output_paths import check_ending
from model.finger import scale_in_words
from model.processes import Progress, check_progress, unseen
from model.rig.rig import Rig
from model.rig.rig_writing import document_of

_NO_ANSWER = "<p>The plate is too small or too weak for three fingers.</p>"


def page(
    rig: Rig,
    path: str | PathLike[str],
    *,
    sensors: Mapping[str, Point] | None = None,
    progress: Progress = unseen,
) -> None:
    """Write one page of HTML about a rig, like `era plate page`.

    - path: name that ends in .html.
    - sensors: positions [m] of sensors to draw, by name.
    - progress: called with the number of steps done and the total.

    Takes a few seconds. Raises InputError, and ConfigError for a rig that `era config check`
    rejects.

    Example:
        >>> era.page(rig, "rig.html")
    """
    expect_instance(rig, Rig, what="rig", made_by='era.load_rig("rig.yaml")')
    check_progress(progress)
    output = expect_path(path, what="path")
    check_ending(output, ".html", ".htm", what="a page")
    places = _checked_sensors({} if sensors is None else sensors, rig)
    report = report_of(rig, document_of(rig), sensors=places, progress=progress)
    text = page_text(report)
    with whole_or_nothing(output) as stream:
        stream.write(text.encode())


def _checked_sensors(sensors: Mapping[str, Point], rig: Rig) -> dict[str, Point]:
    """Return the positions of sensors [m] by name; raises InputError for anything else."""
    expect_instance(sensors, Mapping, what="sensors", made_by='{"P1": (0.1, 0.1)}')
    positions = {}
    for name, position in sensors.items():
        points = as_points(position, what=f"sensor {name}")
        if len(points) != 1:
            raise InputError(f"sensor {name} must have one position, got {len(points)}")
        check_on_plate(f"sensor {name}", points, rig.plate)
        positions[str(name)] = points[0]
    return positions


def page_text(report: RigReport) -> str:
    """Return the page of a report."""
    levels = page_pictures.reachable_levels(report)
    template = resources.files("era_haptics").joinpath("lab/rig_page/page.html")
    return Template(template.read_text(encoding="utf-8")).substitute(
        _figures(report, levels),
        title=escape(page_sections.title_of(report)),
        source=escape(report.source),
        figures=html_of(page_sections.key_figures(report, levels)),
        facts=html_of(table_rows(page_sections.facts(report))),
        least=f"{MIN_CONTRAST_DB:g}",
        own=f"{OWN_CONTRAST_DB:g}",
        scale=escape(scale_in_words(report.rig.threshold)),
        advice=escape(page_sections.advice(report)),
        findings=html_of(page_sections.findings(report)),
        listed=page_sections.listed_modes(report),
        modes=html_of(table_rows(page_sections.modes(report))),
        amplifiers=escape(page_sections.amplifiers(report)),
        wiring=html_of(table_rows(page_sections.wiring(report))),
        version=escape(code_version()),
        fingerprint=report.rig.fingerprint,
        command=escape(_command(report)),
    )


def _figures(report: RigReport, levels: FloatArray) -> dict[str, str]:
    """Draw the figures of a page, by name."""
    with style.context(["default", STYLE]):
        drawing = drawing_picture(report)
        curves = page_pictures.levels_picture(report, levels)
        shapes = page_pictures.modes_picture(report)
        figures = {
            "drawing": svg_of(drawing, "Plate with its parts, drawn to scale"),
            "levels": svg_of(curves, "Reachable level over frequency"),
            "shapes": svg_of(shapes, "Shapes of the first modes"),
            "fingers": _NO_ANSWER,
            "maps": "",
            "costs": "",
        }
        fingers = page_pictures.fingers_picture(report)
        if fingers is not None:
            figures["fingers"] = svg_of(fingers, "Three fingers with three vibrations")
        if report.maps:
            maps = page_pictures.maps_picture(report)
            figures["maps"] = svg_of(maps, "Promised contrast over the plate")
        if report.costs:
            costs = page_pictures.costs_picture(report)
            figures["costs"] = svg_of(costs, "Contrast that each tolerance costs")
    return figures


def _command(report: RigReport) -> str:
    """Return the command that writes the page in the folder of the rig file."""
    source = PurePath(report.source)
    if source.suffix not in (".yaml", ".yml"):
        return 'era.page(rig, "rig.html")'  # a rig that Python built
    sensors = ["--sensors", "SENSORS.csv"] if report.sensors else []
    output = source.with_suffix(".html").name
    return shlex.join(["era", "plate", "page", source.name, *sensors, "-o", output])
