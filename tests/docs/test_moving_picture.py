"""The moving picture of the README, and the script that draws it."""

import colorsys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

import moving_picture

ROOT = Path(__file__).parents[2]
LENGTH, WIDTH = 0.53, 0.30  # m; of examples/car_display.yaml


def hue(color: tuple[float, float, float]) -> float:
    """Return the hue of a color, from 0 to 1."""
    return colorsys.rgb_to_hsv(*color)[0]


def test_fingers_are_drawn_on_patches_of_their_color(tmp_path: Path) -> None:
    """In both frames, the pixels under each finger have the hue of its vibration."""
    path = tmp_path / "two_frames.webp"
    scenes = moving_picture.draw(path, [0.0, 0.5])
    with Image.open(path) as picture:
        assert picture.n_frames == len(scenes) == 2
        for number, scene in enumerate(scenes):
            picture.seek(number)
            pixels = np.asarray(picture.convert("RGB")) / 255
            rows, columns, _ = pixels.shape
            for (x, y), color in zip(scene.positions, moving_picture.CONTENT_COLORS, strict=False):
                row, column = round(rows * (1 - y / WIDTH)), round(columns * x / LENGTH)
                patch = pixels[row - 4 : row + 5, column - 4 : column + 5].mean(axis=(0, 1))
                assert hue(tuple(patch)) == pytest.approx(hue(to_rgb(color)), abs=0.05)
    assert scenes[0].positions[0] != scenes[1].positions[0]
    assert scenes[0].positions[1:] == scenes[1].positions[1:]


def test_picture_of_the_readme_moves_and_is_small() -> None:
    """It has the script's frames, repeats forever, and takes less than 700 kB."""
    path = ROOT / "docs" / "pictures" / "car_display.webp"
    assert "docs/pictures/car_display.webp" in (ROOT / "README.md").read_text("utf-8")
    assert path.stat().st_size < 700_000
    with Image.open(path) as picture:
        assert picture.n_frames == moving_picture.FRAMES
        picture.load()
        assert picture.info["loop"] == 0
        assert picture.info["duration"] == moving_picture.FRAME_MS
