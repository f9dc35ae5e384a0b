"""Files that say where ERAs may stand and where fingers touch."""

import numpy as np
import pytest
from matplotlib.image import imsave

from era_haptics.lab.design.problem import area_of, contact_rule
from model.errors import InputError
from model.rig.rig_file import example_rig_path, load_rig

PLATE = load_rig(example_rig_path()).plate


def test_polygons_hold_their_points(tmp_path) -> None:
    """Candidates and steps are in a triangle, its edges included."""
    path = tmp_path / "where.yaml"
    path.write_text("polygons:\n  left: [[0, 0], [12 cm, 0], [0, 12 cm]]\n")
    area = area_of(str(path), PLATE)
    places = area.candidates(0.02)
    assert len(places) > 5
    assert (places.sum(axis=1) <= 0.12 + 1e-9).all()
    assert area.contains(np.array([[0.06, 0.06], [0.07, 0.06]])).tolist() == [True, False]
    assert (area.moved(np.array([0.06, 0.06]), 0.01).sum(axis=1) <= 0.12 + 1e-9).all()


def test_white_of_a_picture_is_where_eras_may_stand(tmp_path) -> None:
    """The picture's top row is the plate's far side."""
    pixels = np.zeros((21, 28))
    pixels[:5, 14:] = 1.0
    imsave(tmp_path / "mask.png", pixels, cmap="gray", vmin=0, vmax=1)
    area = area_of(str(tmp_path / "mask.png"), PLATE)
    x, y = area.candidates(0.01).T
    assert x.min() >= PLATE.length / 2
    assert y.min() >= 0.75 * PLATE.width
    assert y.max() == PLATE.width


@pytest.mark.parametrize(
    ("rows", "columns", "is_refused"),
    [
        (300, 400, False),
        (306, 400, False),
        (294, 400, False),
        (307, 400, True),
        (293, 400, True),
        (400, 300, True),
        (100, 100, True),
        (22, 30, False),
    ],
)
def test_picture_has_the_proportions_of_the_plate(tmp_path, rows, columns, is_refused) -> None:
    """12 by 9 inches is 400 by 300 pixels, to 2 % of the height or half a pixel."""
    path = tmp_path / "mask.png"
    imsave(path, np.ones((rows, columns)), cmap="gray", vmin=0, vmax=1)
    if not is_refused:
        assert area_of(str(path), PLATE).contains(np.array([[0.1, 0.1]])).all()
        return
    with pytest.raises(InputError, match=rf"mask\.png.*0\.3048 m.*{columns} by {rows} pixels"):
        area_of(str(path), PLATE)


@pytest.mark.parametrize(
    "shape",
    [
        "rectangle: {start: [25 cm, 5 cm], end: [31 cm, 10 cm]}",
        "circle: {at: [2 cm, 10 cm], radius: 3 cm}",
        "polygon: [[1 cm, 1 cm], [5 cm, 23 cm], [5 cm, 1 cm]]",
        "circle: {at: [50 cm, 50 cm], radius: 2 cm}",
    ],
)
def test_regions_off_the_plate_are_refused(tmp_path, shape) -> None:
    """In part or wholly, of a plate of 12 by 9 inches, by file, line, name and size."""
    path = tmp_path / "contacts.yaml"
    path.write_text(
        "regions:\n"
        "  on: {rectangle: {start: [0, 0], end: [12 in, 9 in]}}\n"
        f"  off: {{{shape}}}\n"
    )
    with pytest.raises(InputError, match=r"contacts\.yaml:3: regions\.off.*0\.3048 m by 0\.2286 m"):
        contact_rule(path, PLATE)


def test_contacts_in_regions_of_a_layout(tmp_path) -> None:
    """Fingers are in the regions, so many of them, so far apart; effects are passed over."""
    path = tmp_path / "layout.yaml"
    path.write_text(
        "quiet: [2, 2]\napart: 4 cm\nelsewhere: null\nregions:\n"
        "  a: {rectangle: {start: [0, 0], end: [5 cm, 5 cm]}, on_press: click}\n"
        "  b: {circle: {at: [20 cm, 10 cm], radius: 4 cm}}\n"
    )
    rule = contact_rule(path, PLATE)
    for contacts in [*rule.sets(20, seed=1), *rule.pooled_sets(10, seed=1)]:
        assert len(contacts) == 3
        in_a = (contacts <= 0.05).all(axis=1)
        in_b = np.hypot(*(contacts - [0.2, 0.1]).T) <= 0.04
        assert (in_a | in_b).all()
        gaps = np.linalg.norm(contacts[:, None] - contacts, axis=-1)
        assert gaps[np.triu_indices(3, 1)].min() > 0.04


@pytest.mark.parametrize(
    "text",
    [
        "",
        "sets: []",
        "regions: {}",
        "quiet: [3, 1]\nregions: {a: {circle: {at: [0.1, 0.1], radius: 0.02}}}",
        "regions: {a: {on_press: click}}",
        "sets: [{target: [9, 0.1], quiet: [[0.2, 0.1]]}]",
        "sets: [{target: [0.1, 0.1], quiet: []}]",
        "fingers: 3",
    ],
)
def test_files_of_contacts_that_say_nothing_are_refused(tmp_path, text) -> None:
    """No region, an order turned round, no shape, a place off the plate, no quiet finger."""
    path = tmp_path / "contacts.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"contacts\.yaml"):
        contact_rule(path, PLATE)


@pytest.mark.parametrize(
    "name", ["nowhere.png", "broken.png", "nowhere.yaml", "empty.yaml", "inside"]
)
def test_area_that_cannot_be_read_is_refused(tmp_path, name) -> None:
    """A missing file, a picture that is none, a word that is neither."""
    (tmp_path / "broken.png").write_bytes(b"not a picture")
    (tmp_path / "empty.yaml").touch()
    with pytest.raises(InputError):
        area_of(str(tmp_path / name), PLATE)
