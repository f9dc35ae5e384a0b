"""Take pictures of the dashboard on every screen.

    python tests/programs/dashboard_pictures.py FOLDER

A daemon over a simulated amplifier is armed, and two people have a finger each on the plate. The
screens are a desktop, a tablet and phones. docs/pictures/dashboard.png is dashboard_desktop.png.
"""

import asyncio
import json
import sys
import tempfile
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from controller.demo.demonstration import layout_of_people
from kit.plates import make_paper_rig
from model.table.table_file import build_table
from processes.gateways import GatewayProcess, Page, gateway_process, open_browser, real_daemon


@dataclass(frozen=True)
class Screen:
    """A screen's size in CSS pixels, and whether it is held in a hand."""

    name: str
    width: int
    height: int
    is_phone: bool = False


SCREENS = (
    Screen("desktop", 1280, 800),
    Screen("tablet", 820, 1180, is_phone=True),
    Screen("phone", 390, 844, is_phone=True),
    Screen("phone_across", 844, 390, is_phone=True),
    Screen("small_phone", 320, 568, is_phone=True),
)
STATE = "document.querySelector('#state')?.dataset.state"
REASON = "document.querySelector('#banner')?.dataset.reason"
"""Why the banner is shown."""
TWO_PEOPLE = ((0.1, 0.5), (0.72, 0.74))
"""One in each strip of the demonstration's layout."""
PLACES = ((0.82, 0.235), (0.82, 0.825))
"""On the keypad and on the knob of the example's layout, as `on_plate` has it."""


async def open_dashboard(page: Page, gateway: GatewayProcess, screen: Screen) -> None:
    """Show the dashboard by the URL that the gateway prints, and wait until it is connected."""
    await page.show(
        f"{gateway.url}#token={gateway.token}",
        width=screen.width,
        height=screen.height,
        is_phone=screen.is_phone,
    )
    await page.until(STATE, lambda state: state not in (None, "disconnected", "NOT_READY"))
    await page.until("document.querySelectorAll('#layer-eras rect').length")


async def on_plate(page: Page, *shares: tuple[float, float]) -> list[tuple[float, float]]:
    """Places on the plate, given in parts of its width and height from its upper left corner, as
    places on the screen."""
    await page.evaluate("document.querySelector('#plate').scrollIntoView({block: 'nearest'})")
    box = await page.evaluate(
        "(({x, y, width, height}) => [x, y, width, height])"
        "(document.querySelector('#plate').getBoundingClientRect())"
    )
    return [(box[0] + x * box[2], box[1] + y * box[3]) for x, y in shares]


@asynccontextmanager
async def fingers_down(page: Page, *shares: tuple[float, float]) -> AsyncIterator[None]:
    """Real touches of the plate, for as long as it takes."""
    await page.touch("touchStart", await on_plate(page, *shares))
    try:
        yield
    finally:
        await page.touch("touchEnd", [])


@contextmanager
def two_people(folder: Path) -> Iterator[Path]:
    """The socket of a daemon in which two people each feel a content of their own."""
    rig = make_paper_rig(12, 9)
    table = build_table(rig, frequencies=np.arange(60.0, 301.0, 20.0), drive_mode="phased")
    layout = layout_of_people(rig.plate, {"left": None, "right": None})
    (folder / "layout.yaml").write_text(json.dumps(layout), encoding="utf-8")
    with real_daemon(folder, "layouts: {panel: layout.yaml}\n", table=table) as socket:
        yield socket


async def _take(folder: Path) -> None:
    with (
        tempfile.TemporaryDirectory() as work,
        two_people(Path(work)) as daemon,
        gateway_process(Path(work), daemon) as gateway,
    ):
        async with open_browser(Path(work) / "profile") as browser:
            for screen in SCREENS:
                async with browser.open_page() as page:
                    await open_dashboard(page, gateway, screen)
                    await page.until("!document.querySelector('#arm').disabled")
                    await page.click("#arm")
                    await page.until(f"{STATE} === 'OPERATION_ENABLED'")
                    async with fingers_down(page, *TWO_PEOPLE):
                        await page.until("document.querySelectorAll('.contact').length === 2")
                        await page.until("document.querySelectorAll('#layers button').length === 3")
                        # Solved after the event.
                        field = "document.querySelector('#scale-high').textContent"
                        await page.until(f"{field}.includes('dB SL')")
                        await asyncio.sleep(0.3)
                        await page.screenshot(folder / f"dashboard_{screen.name}.png")
                    await page.click("#disarm")
                    await page.until(f"{STATE} === 'READY_TO_SWITCH_ON'")


if __name__ == "__main__":
    asyncio.run(_take(Path(sys.argv[1])))
