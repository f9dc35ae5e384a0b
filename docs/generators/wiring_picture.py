"""Picture of the wiring of the weekend plate, from the computer to the exciters and back."""

from collections.abc import Iterator, Sequence

Point = tuple[float, float]

RED, BLACK, BLUE, GREEN, GREY = "#c62828", "#222222", "#1565c0", "#2e7d32", "#33475b"
ROWS = {"NE": 92, "NW": 132, "SW": 172, "SE": 212}
"""Vertical position of each exciter's row, in the order of outputs."""
BOARD = (700, 66, 200, 153)
PLACES = {"NE": (868, 100), "NW": (754, 95), "SW": (736, 182), "SE": (858, 193)}
WAYS: dict[str, Sequence[Point]] = {
    "NE": [(640, 92), (640, 48), (868, 48), (868, 88)],
    "NW": [(655, 132), (655, 95), (742, 95)],
    "SW": [(655, 172), (655, 182), (724, 182)],
    "SE": [(640, 212), (640, 240), (858, 240), (858, 205)],
}
TITLE = "Wiring: four outputs of a sound card through an amplifier to four exciters, a sensor back"


def wiring() -> str:
    """Return the picture as SVG."""
    lines = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 960 392" font-family="sans-serif" '
        'font-size="13" role="img">',
        f"<title>{TITLE}</title>",
        '<rect width="960" height="392" fill="#ffffff"/>',
        *_computer_and_card(),
        *_amplifier(),
        *_board(),
        *_sensor_and_loop(),
    ]
    return "\n  ".join(lines) + "\n</svg>\n"


def _box(x: float, y: float, width: float, height: float, *text: str, fill: str = "#eef3f8") -> str:
    """Return a box with lines of text at its top."""
    words = "".join(
        _text((x + width / 2, y + 18 + 15 * n), each, anchor="middle")
        for n, each in enumerate(text)
    )
    rect = f'<rect x="{x}" y="{y}" width="{width}" height="{height}"'
    return f'{rect} fill="{fill}" stroke="{GREY}"/>{words}'


def _text(at: Point, text: str, *, anchor: str = "start", color: str = BLACK) -> str:
    return f'<text x="{at[0]}" y="{at[1]}" text-anchor="{anchor}" fill="{color}">{text}</text>'


def _line(points: Sequence[Point], color: str, *, width: float = 2, dashes: str = "none") -> str:
    path = " ".join(f"{x},{y}" for x, y in points)
    stroke = f'stroke="{color}" stroke-width="{width}" stroke-dasharray="{dashes}"'
    return f'<polyline points="{path}" fill="none" {stroke}/>'


def _computer_and_card() -> Iterator[str]:
    yield _box(16, 112, 110, 60, "computer", "with era")
    yield _line([(126, 142), (190, 142)], GREY, width=4)
    yield _text((158, 134), "USB", anchor="middle")
    yield _box(190, 30, 170, 312, "sound card", "one clock, 48 kHz")
    for number, (name, y) in enumerate(ROWS.items(), start=1):
        yield _text((352, y + 4), f"output {number}", anchor="end")
        yield _line([(360, y), (440, y)], BLUE)
        yield _text((366, y - 5), name, color=BLUE)
    yield _text((352, 292), "input 1", anchor="end")
    yield _text((352, 328), "input 2", anchor="end")


def _amplifier() -> Iterator[str]:
    yield _box(440, 30, 170, 208, "four-channel amplifier", "volume fixed, marked")
    for number, (name, y) in enumerate(ROWS.items(), start=1):
        yield _text((448, y + 4), f"in {number}")
        yield _text((586, y + 4), f"out {number}", anchor="end")
        ends = [(610, y), *WAYS[name]]
        yield _line([(x, each + 5) for x, each in ends[:1]] + _beside(WAYS[name]), BLACK)
        yield _line(ends, RED)
        yield _text((590, y - 1), "+", color=RED) + _text((590, y + 12), "−")
    yield _line([(525, 238), (525, 262)], GREY, width=4)
    yield _box(465, 262, 120, 26, "power supply")


def _beside(way: Sequence[Point]) -> list[Point]:
    """Return the path of the second wire of a pair, at a distance of 5 from the first."""
    return [(x + 5, y + 5) for x, y in way[:-1]] + [
        (way[-1][0] + 5 * (way[-1][0] == way[-2][0]), way[-1][1] + 5 * (way[-1][1] == way[-2][1]))
    ]


def _board() -> Iterator[str]:
    x, y, width, height = BOARD
    yield _text((x + 84, 36), "board, seen from above, on foam", anchor="middle")
    yield f'<rect x="{x}" y="{y}" width="{width}" height="{height}" fill="none" stroke="{GREY}"/>'
    for across, down in ((0.22, 0.5), (0.78, 0.5), (0.5, 0.2), (0.5, 0.8)):
        yield _box(x + across * width - 7, y + down * height - 7, 14, 14, fill="#e8dcc0")
    for name, (at, down) in PLACES.items():
        yield f'<circle cx="{at}" cy="{down}" r="12" fill="#d98c3f" stroke="{GREY}"/>'
        yield _text((at - 26, down + 5) if at > 800 else (at, down + 26), name, anchor="middle")
    yield _text((x, 258), "exciters underneath, + to +", color=RED)


def _sensor_and_loop() -> Iterator[str]:
    yield _box(778, 121, 14, 14, fill="#c8e6c9")
    cable = [(360, 288), (440, 288), (440, 306), (670, 306), (670, 128), (778, 128)]
    yield _line(cable, GREEN, dashes="7 4")  # distinguishable from red wires without color
    yield _text((676, 300), "accelerometer and its supply: move it", color=GREEN)
    yield _text((676, 316), "to each position, arrow upwards", color=GREEN)
    yield _line([(400, 212), (400, 324), (360, 324)], BLUE)
    yield '<circle cx="400" cy="212" r="4" fill="#1565c0"/>'
    yield _text((408, 342), "Y-cable: output 4 back to input 2, the delay reference", color=BLUE)
    text = "Red: +. Black: −. An exciter with swapped wires moves against the others."
    yield _text((16, 376), text)
