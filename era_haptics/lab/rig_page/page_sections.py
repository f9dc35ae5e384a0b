"""Words and tables of a rig's page, as elements of HTML."""

from collections.abc import Iterable, Iterator, Sequence
from xml.etree.ElementTree import Element, SubElement, tostring

from era_haptics.lab.rig_page.page_pictures import tolerance_words
from era_haptics.lab.rig_page.rig_report import RigReport
from model.arrays import FloatArray
from model.finger import STRONG_DB_SL
from model.quantities import counted
from model.rig.rig_summary import plate_in_words, plate_summary

MAX_MODES = 54
"""Largest number of modes in the page's table."""


def html_of(elements: Iterable[Element]) -> str:
    """Return the text of elements, with escaped content."""
    return "".join(tostring(element, encoding="unicode", method="html") for element in elements)


def title_of(report: RigReport) -> str:
    """Return plate and actuators in words."""
    kinds = {type(era).__name__ for era in report.rig.eras}
    kind = "exciter" if kinds == {"Exciter"} else "ERA"
    return f"{plate_in_words(report.rig)} on {counted(len(report.rig.eras), kind)}"


def key_figures(report: RigReport, levels: FloatArray) -> Iterator[Element]:
    """Yield the most important values with their names; levels (f, p) [dB SL]: reachable."""
    for count in (2, 3, 4):
        contrast = report.summary[f"promised_contrast_{count - 1}_quiet_median_db"]
        if contrast is not None:
            yield _figure(f"{contrast:.0f} dB", f"promised contrast among {count} fingers (median)")
    weakest = levels.max(axis=0).min()
    words = f"reached at the weakest position; {STRONG_DB_SL:g} is strong"
    yield _figure(f"{weakest:.0f} dB SL", words)
    frequencies = report.modes.natural_frequencies
    highest = report.rig.limits.frequency_max
    words = f"up to {highest:g} Hz"
    if len(frequencies):
        words += f", the first at {frequencies[0]:.0f} Hz"
    yield _figure(counted(len(frequencies), "mode"), words)


def _figure(value: str, words: str) -> Element:
    figure = Element("div")
    SubElement(figure, "dt").text = words
    SubElement(figure, "dd").text = value
    return figure


def table_rows(rows: Iterable[Sequence[str]]) -> Iterator[Element]:
    """Yield the rows of a table, whose first cells are headings."""
    for heading, *cells in rows:
        row = Element("tr")
        SubElement(row, "th", scope="row").text = heading
        for cell in cells:
            SubElement(row, "td").text = cell
        yield row


def facts(report: RigReport) -> Iterator[tuple[str, str]]:
    """Yield names and values of the plate's properties."""
    rig, summary = report.rig, plate_summary(report.rig)
    at_low, at_high = summary["bending_wavelength_m"].values()
    yield "mass", f"{summary['mass_kg']:.3g} kg"
    yield "flexural rigidity", f"{summary['flexural_rigidity_n_m']:.3g} N m"
    yield "loss factor", f"{summary['loss_factor']:g}"
    yield "bending wavelength", f"{100 * at_low:.3g} to {100 * at_high:.3g} cm"
    yield "frequencies", f"{rig.limits.frequency_min:g} to {rig.limits.frequency_max:g} Hz"
    yield "level limit", f"{100 * rig.limits.level:.3g} % of full amplitude"
    yield "feet", ", ".join(rig.foot_names) if rig.feet else "none"
    x, y = report.center
    yield "center of mass", f"{1000 * x:.4g}, {1000 * y:.4g} mm"
    yield "tolerances", str(rig.uncertainty)
    yield "mesh error", f"{report.summary['discretisation_error_percent']:.2g} %"


def wiring(report: RigReport) -> Iterator[tuple[str, str, str]]:
    """Yield name, position and channel of each actuator."""
    for era in report.rig.eras:
        channel = report.rig.wiring[era.name]
        position = f"{1000 * era.x:.4g}, {1000 * era.y:.4g} mm"
        yield era.name, position, f"{channel.amplifier} {channel.number}"


def amplifiers(report: RigReport) -> str:
    """Return names and URLs of the amplifiers."""
    return ", ".join(f"{name}: {url}" for name, url in report.rig.amplifiers.items())


def modes(report: RigReport) -> Iterator[tuple[str, str, str]]:
    """Yield number, natural frequency and damping ratio of each mode, up to MAX_MODES."""
    found = report.modes
    pairs = zip(found.natural_frequencies, found.damping_ratios, strict=True)
    for number, (frequency, damping) in enumerate(pairs, start=1):
        if number <= MAX_MODES:
            yield f"{number}", f"{frequency:.1f} Hz", f"{100 * damping:.1f} %"


def listed_modes(report: RigReport) -> str:
    """Return the content of the table of modes in words."""
    count = len(report.modes.natural_frequencies)
    modes_in_words = (
        "all modes" if count <= MAX_MODES else f"the first {MAX_MODES} of {count} modes"
    )
    return f"{modes_in_words} with their damping ratios"


def advice(report: RigReport) -> str:
    """Return which tolerance to measure first."""
    if not report.costs:
        return "None: tolerances are zero, or the plate is too small or too weak for two fingers."
    key, cost = next(iter(report.costs.items()))
    tolerance = tolerance_words(key, report.rig.uncertainty)
    return (
        "Increase of the promised contrast to a quiet finger, up to 250 Hz and on average, if a "
        f"tolerance were zero. Measure first: {tolerance}, which costs {cost:.1f} dB."
    )


def findings(report: RigReport) -> Iterator[Element]:
    """Yield the findings of `era config check`."""
    if not report.warnings:
        good = Element("p")
        good.text = "None: era config check prints no warning."
        yield good
        return
    items = Element("ul")
    for warning in report.warnings:
        SubElement(items, "li").text = warning
    yield items
