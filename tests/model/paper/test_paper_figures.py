"""The paper's figures: the numbers beside them, against what the paper prints and claims.

Checks and their bounds: the paper's Tables 1 and 2 and its sections 3.2 and 3.3, with the ERA
parameters recovered from Table 2.
"""

from dataclasses import replace

import numpy as np
import pytest

from model.errors import InputError
from model.paper.catalogue import paper_figures
from model.paper.figure import PaperFigure
from paper_plate import make_paper_rig


@pytest.fixture(scope="module")
def figures() -> dict[str, PaperFigure]:
    """All figures of the paper's rig, on a mesh that is near converged."""
    return {made.name: made for made in paper_figures(make_paper_rig(48, 36), "all")}


def peaks(figure: PaperFigure) -> dict[str, np.ndarray]:
    """The maps of a figure as its CSV file has them, by column."""
    return {
        name: np.asarray(column)
        for name, column in figure.tables[""].items()
        if name.startswith("peak_")
    }


def test_figure_6_reproduces_table_1(figures):
    """Five frequencies on the paper's mesh are the printed ones, beside Eq. 29."""
    table = figures["figure_6"].tables[""]
    # Half up, as the paper rounds: 110.945 is 110.95.
    ours = [np.floor(100 * value + 0.5) / 100 for value in table["model_12x9_hz"]]
    assert ours == [110.95, 234.16, 337.90, 454.29, 459.69]
    np.testing.assert_allclose(
        table["analytical_hz"], [109.70, 228.17, 320.31, 425.62, 438.79], atol=0.006
    )
    np.testing.assert_allclose(table["model_fine_hz"], table["comsol_hz"], rtol=0.005)


def test_figure_7_reproduces_table_2(figures):
    """Frequencies on ERAs are the printed ones; the fine mesh is within 0.5 % of COMSOL."""
    table = figures["figure_7"].tables[""]
    assert [f"{value:.2f}" for value in table["model_12x9_hz"]] == [
        "31.98", "68.50", "76.62", "107.84", "160.77",
    ]  # fmt: skip
    np.testing.assert_allclose(table["model_fine_hz"], table["comsol_hz"], rtol=0.005)


def test_figure_6_shapes_are_half_waves(figures):
    """sin(pi x / L) sin(pi y / b); mode 5 has two half waves along both sides."""
    shapes = figures["figure_6"].tables["_shapes"]
    x, y = np.asarray(shapes["x_m"]) / 0.3048, np.asarray(shapes["y_m"]) / 0.2286
    for mode, waves in (("mode_1", 1), ("mode_5", 2)):
        by_hand = np.sin(waves * np.pi * x) * np.sin(waves * np.pi * y)
        shape = np.asarray(shapes[mode])
        np.testing.assert_allclose(shape * np.sign(shape @ by_hand), by_hand, atol=0.02)


def test_figure_11_best_pair_exceeds_best_single_era(figures):
    """Section 3.2: the best pair has a higher median than the best single ERA, in each layout."""
    gain = figures["figure_11_boxplots"].findings["median_two_to_one_era_ratio"]
    assert len(gain) >= 5
    assert all(ratio > 1 for ratio in gain.values())


@pytest.mark.parametrize(("name", "sets"), [("figure_10", 4), ("figure_11_boxplots", 6)])
def test_box_plots_list_every_activation_set(figures, name, sets):
    """Seven layouts, each with its four ERAs or six pairs; quartiles in order, above zero."""
    table = figures[name].tables[""]
    assert len(table["layout"]) == 7 * sets
    five = np.array(
        [
            table[f"{key}_m_s2"]
            for key in ("minimum", "lower_quartile", "median", "upper_quartile", "maximum")
        ]
    )
    assert (np.diff(five, axis=0) > 0).all()
    assert five.min() > 0


def test_figure_11_edge_and_diagonal_maxima_agree(figures):
    """Section 3.2, 110 Hz: a negligible change in maximum, about 1 %, but other nulls."""
    edge, diagonal = peaks(figures["figure_11_maps"]).values()
    assert edge.max() / diagonal.max() == pytest.approx(1.0, abs=0.015)
    assert figures["figure_11_maps"].findings["edge_nulls_kept_on_diagonal_share"] < 0.6
    assert np.corrcoef(edge, diagonal)[0, 1] < 0.99


def test_figure_12_patterns_together_leave_few_nulls(figures):
    """Section 3.3: together the six leave under 5 % of the plate below 30 % of their maxima."""
    maps = peaks(figures["figure_12"])
    assert len(maps) == 6
    still = np.all([peak < 0.3 * peak.max() for peak in maps.values()], axis=0)
    assert 0 < still.mean() < 0.05
    # Alone each leaves several times as much.
    assert all((peak < 0.3 * peak.max()).mean() > 0.2 for peak in maps.values())


def test_figure_12_swapped_frequencies_rotate_the_map(figures):
    """300 and 100 Hz exchanged between opposite corners: the same map, rotated."""
    maps = peaks(figures["figure_12"])
    there, back = maps["peak_300_100_hz_m_s2"], maps["peak_100_300_hz_m_s2"]
    np.testing.assert_allclose(there, back[::-1], rtol=1e-5, atol=1e-5 * there.max())


def test_figure_13_doubled_stiffness_scales_the_map(figures):
    """Section 3.3, 250 Hz, 8 to 16 kN/m: 1.5 to 1.8 times the maximum, correlation above 0.98."""
    soft, stiff = peaks(figures["figure_13_maps"]).values()
    assert 1.5 < stiff.max() / soft.max() < 1.8
    assert np.corrcoef(soft, stiff)[0, 1] > 0.98


def test_figure_13_study_contains_the_maps(figures):
    """At 8 and 16 kN/m the study's maxima are those of the two maps, at 17 kN/m it is the map."""
    study = figures["figure_13_stiffness"].tables[""]
    stiffness = np.asarray(study["stiffness_n_m"])
    for value, peak in zip(
        (8000.0, 16000.0), peaks(figures["figure_13_maps"]).values(), strict=True
    ):
        row = int(np.abs(stiffness - value).argmin())
        assert stiffness[row] == pytest.approx(value)
        assert study["maximum_m_s2"][row] == pytest.approx(peak.max())
    correlation = np.asarray(study["correlation"])
    assert stiffness[correlation.argmax()] == pytest.approx(17_000, rel=0.1)
    assert correlation.max() <= 1 + 1e-12


def test_figures_of_another_plate_have_no_printed_columns():
    """Only the paper's plate can be compared with what the paper prints."""
    rig = make_paper_rig(12, 9)
    thick = replace(rig, plate=replace(rig.plate, thickness=0.002))
    (made,) = paper_figures(thick, "6")
    assert list(made.tables[""]) == ["mode", "analytical_hz", "model_12x9_hz", "model_fine_hz"]
    (made,) = paper_figures(replace(rig, eras=rig.eras[:3]), "7")
    assert list(made.tables[""]) == ["mode", "model_12x9_hz", "model_fine_hz"]


@pytest.mark.parametrize("number", ["1", "8", "14", "", "figure_6"])
def test_paper_figures_refuses_an_unknown_number(number):
    """Figures 1 to 5, 8 and 9 are sketches; others are not there."""
    with pytest.raises(InputError, match=r"^figure .* 6, 7, 10"):
        list(paper_figures(make_paper_rig(12, 9), number))
