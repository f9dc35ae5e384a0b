"""The dashboard in a real browser, with a real daemon over a simulated amplifier.

One browser and one daemon for all tests, and one tab for those that load nothing anew.
"""

import asyncio
import math
import re
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import pytest_asyncio

from controller.api.client import Client
from controller.api.jsonrpc import RpcError
from controller.effects.layout import LAYOUT, load_layout
from dashboard_pictures import (
    PLACES,
    REASON,
    SCREENS,
    STATE,
    TWO_PEOPLE,
    fingers_down,
    on_plate,
    open_dashboard,
    two_people,
)
from processes.daemons import PATIENCE
from processes.gateways import (
    TOKEN,
    Browser,
    GatewayProcess,
    Page,
    gateway_process,
    real_daemon,
    wait_for,
    wait_for_state,
)

pytestmark = pytest.mark.asyncio(loop_scope="module")

READY, ENABLED, STOPPED = "READY_TO_SWITCH_ON", "OPERATION_ENABLED", "QUICK_STOP_ACTIVE"
LENGTH, WIDTH = 0.3048, 0.2286  # m; 12 by 9 inches, as in the rig's file
DESKTOP, PHONE = SCREENS[0], SCREENS[2]
WORD = "document.querySelector('#state').textContent"
PROBES = Path(__file__).with_name("page_probes.js").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A daemon with the example's surface layout, by two names."""
    folder = tmp_path_factory.mktemp("daemon")
    (folder / "layout.yaml").write_text(LAYOUT.example(), encoding="utf-8")
    with real_daemon(
        folder,
        "layouts: {panel: layout.yaml, other: layout.yaml}\n",
    ) as path:
        yield path


@pytest.fixture(scope="module")
def gateway(daemon: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[GatewayProcess]:
    """Its gateway."""
    with gateway_process(tmp_path_factory.mktemp("gateway"), daemon) as process:
        yield process


@pytest.fixture
def era(daemon: Path) -> Iterator[Client]:
    """A client of the daemon, ready to be armed; disarmed afterwards."""
    with Client.connect(daemon, name="test") as client:
        yield client
        if client.status().state in (STOPPED, "FAULT"):
            client.clear()
        client.disarm()


@pytest_asyncio.fixture(loop_scope="module")
async def fresh(tab: Page, gateway: GatewayProcess, era: Client) -> Page:
    """The dashboard on a desktop, connected, in a tab of its own."""
    await open_dashboard(tab, gateway, DESKTOP)
    await settled(tab, era)
    return tab


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def shared(browser: Browser, gateway: GatewayProcess) -> AsyncIterator[Page]:
    """The dashboard in a tab that no test leaves or loads anew."""
    async with browser.open_page() as page:
        await open_dashboard(page, gateway, DESKTOP)
        yield page


@pytest_asyncio.fixture(loop_scope="module")
async def page(shared: Page, era: Client) -> Page:
    """That dashboard on a desktop, connected, in light colours, nothing focused."""
    await shared.fit(DESKTOP.width, DESKTOP.height)
    await shared.dark(False)
    await shared.evaluate("document.activeElement.blur(); window.scrollTo(0, 0)")
    await settled(shared, era)
    return shared


async def settled(page: Page, era: Client) -> None:
    """Wait until all is disarmed. A stop is sent twice: the second may arrive after a clear."""
    async with asyncio.timeout(PATIENCE):
        while await page.evaluate(STATE) != READY or era.status().state != READY:
            if era.status().state in (STOPPED, "FAULT"):
                with suppress(RpcError):  # refused while the stop is under way
                    era.clear()
            await asyncio.sleep(0.1)


async def until_state(era: Client, *states: str) -> None:
    """Wait for a state of the daemon while the browser runs."""
    await asyncio.to_thread(wait_for_state, era, *states)


async def contacts(era: Client, count: int) -> list[tuple[float, float]]:
    """The daemon's contacts [m], as soon as there are so many."""
    await asyncio.to_thread(wait_for, lambda: len(era.status().contacts) == count)
    return [(contact.x_m, contact.y_m) for contact in era.status().contacts]


async def until_last(era: Client, accepts: Callable[[float], bool]) -> None:
    """Wait until the last contact's x [m] is accepted; on a busy machine it may lapse meanwhile."""
    await asyncio.to_thread(
        wait_for, lambda: any(accepts(contact.x_m) for contact in era.status().contacts[-1:])
    )


async def arm(page: Page, era: Client) -> None:
    """Arm by the button."""
    await page.click("#arm")
    await until_state(era, ENABLED)
    await page.until(f"{STATE} === 'OPERATION_ENABLED'")


async def test_page_shows_the_rig_without_console_messages(page: Page) -> None:
    """ERAs, regions, the banner of a simulation, the amplifier; all requests go to the gateway."""
    assert await page.evaluate(REASON) == "simulated"
    names = await page.evaluate(
        "[...document.querySelectorAll('#overlay text')].map(e => e.textContent)"
    )
    assert set(names) == {"SW", "SE", "NE", "NW", "keypad", "slider", "knob", "tuner", "patch"}
    shapes = await page.evaluate("[...document.querySelectorAll('.region')].map(e => e.tagName)")
    assert sorted(shapes) == ["circle", "circle", "polygon", "rect", "rect"]
    tile = await page.until("document.querySelector('.tile')?.innerText")
    assert "main" in tile
    assert "°C" in tile
    assert "just now" in tile
    await page.until(
        "[...document.querySelectorAll('#effects button')].map(e => e.textContent).join()",
        lambda names: names == ",".join(sorted(load_layout(LAYOUT.example_file, None).effects)),
    )
    origins = await page.evaluate(
        "[...new Set(performance.getEntriesByType('resource').map(e => new URL(e.name).origin))]"
        ".filter(origin => origin !== location.origin)"
    )
    assert origins == []
    assert await page.evaluate("location.hash") == ""  # the token is not to be seen
    assert page.complaints == []


@pytest.mark.long
async def test_each_finger_has_its_content_in_a_colour_of_its_own(
    tab: Page, tmp_path: Path
) -> None:
    """Two touches: two rings, around each the field of its colour, and one content if chosen.

    Where a content is drawn alone, its own finger is on a brighter place than the other.
    """
    fingers = f"({PROBES}).fingersOn('#field')"
    choices = "[...document.querySelectorAll('#layers button')].map(e => e.textContent)"
    with (
        two_people(tmp_path) as socket,
        gateway_process(tmp_path, socket) as gateway,
        Client.connect(socket, name="test") as era,
    ):
        await open_dashboard(tab, gateway, DESKTOP)
        await settled(tab, era)
        await arm(tab, era)
        async with fingers_down(tab, *TWO_PEOPLE):
            await tab.until(choices, lambda texts: len(texts) == 3)
            frequencies = sorted(contact.frequency_hz or 0.0 for contact in era.status().contacts)
            assert sorted(await tab.evaluate(choices)) == sorted(
                ["all", *(f"{frequency:.0f} Hz" for frequency in frequencies)]
            )
            summary = await tab.evaluate("document.querySelector('#summary').textContent")
            for frequency in frequencies:
                assert re.search(f"{frequency:.0f} Hz (own|mixed), ", summary)
            (first, _), (second, _) = await tab.until(fingers, is_in_own_colours)
            assert first != second
            for number in (2, 3):
                button = f"#layers button:nth-child({number})"
                name = await tab.evaluate(f"document.querySelector('{button}').textContent")
                west = min(era.status().contacts, key=lambda contact: contact.x_m)
                differs = f"{west.frequency_hz:.0f} Hz" != name
                await tab.click(button)
                await tab.until(fingers, partial(is_brighter_at, differs))
            await tab.click("#layers button")
            await tab.until(fingers, is_in_own_colours)
        assert await contacts(era, 0) == []
        await tab.until(choices, lambda texts: not texts)
    assert tab.complaints == []


def is_in_own_colours(fingers: list[list[list[int]]]) -> bool:
    """Whether the ground of both fingers is a shade of the colour of their rings, no grey."""
    return len(fingers) == 2 and all(
        np.argsort(ring).tolist() == np.argsort(ground).tolist()
        and max(ground) > 1.3 * min(ground) + 10
        for ring, ground in fingers
    )


def is_brighter_at(index: int, fingers: list[list[list[int]]]) -> bool:
    """Whether the ground of one of two fingers is brighter than that of the other."""
    brightness = [sum(ground) for _, ground in fingers]
    return len(brightness) == 2 and brightness[index] > brightness[1 - index]


async def test_touches_become_contacts_of_the_daemon(page: Page, era: Client) -> None:
    """Two at once, at their places in meters, moved and lifted; the last one is the target."""
    await arm(page, era)
    async with fingers_down(page, *PLACES):
        for (x, y), (right, down) in zip(await contacts(era, 2), PLACES, strict=True):
            assert x == pytest.approx(right * LENGTH, abs=1e-3)
            assert y == pytest.approx((1 - down) * WIDTH, abs=1e-3)
        await page.until("document.querySelectorAll('.contact').length === 2")
        await page.until("document.querySelectorAll('.contact.target').length === 1")
        await page.until(
            "document.querySelector('#summary').textContent",
            lambda text: re.search(r"\b2\b.* dB SL.* dB ", text) is not None,
        )
        scale = await page.evaluate("document.querySelector('#threshold-set').innerText")
        assert scale == f"thresholds: {era.status().threshold}"
        await page.touch("touchMove", await on_plate(page, (0.2, 0.7), (0.6, 0.5)))
        await until_last(era, lambda x: abs(x - 0.6 * LENGTH) < 1e-3)
    assert await contacts(era, 0) == []
    await page.until("document.querySelectorAll('.contact').length === 0")
    await page.until(
        "document.querySelector('#latency-numbers').textContent",
        lambda text: re.search(r"\d ms", text) is not None,
    )
    assert await page.evaluate("document.querySelectorAll('#latency rect').length") > 5
    assert page.complaints == []


async def test_cancelled_touches_are_lifted(page: Page, era: Client) -> None:
    """Cancelled, as a palm is, or when the window loses focus: a hand, of 100 pixels or 26 mm."""
    for end in ("touchCancel", "blur"):
        await page.touch("touchStart", await on_plate(page, (0.5, 0.5)), radius=50)
        await page.until("document.querySelectorAll('.contact.hand').length === 1")
        if end == "blur":
            await page.evaluate("window.dispatchEvent(new Event('blur'))")
            await contacts(era, 0)
            await page.touch("touchEnd", [])
        else:
            await page.touch(end, [])
            await contacts(era, 0)


async def test_mouse_is_a_finger_while_its_button_is_down(page: Page, era: Client) -> None:
    """Hovering has no effect; it is lifted wherever the button is released."""
    ((x, y),) = await on_plate(page, (0.25, 0.5))
    await page.mouse("mouseMoved", x, y, button="none")
    assert await contacts(era, 0) == []
    await page.mouse("mousePressed", x, y)
    ((position, _),) = await contacts(era, 1)
    assert position == pytest.approx(0.25 * LENGTH, abs=1e-3)
    await page.mouse("mouseMoved", x + 2000, y)  # dragged off the plate: at its edge
    await until_last(era, lambda x: x > LENGTH - 1e-3)
    await page.mouse("mouseReleased", x + 2000, y)
    assert await contacts(era, 0) == []


async def test_keyboard_is_a_finger(page: Page, era: Client) -> None:
    """Enter puts it down in the middle, arrows move it by 5 mm, Enter or Tab lifts it."""
    await page.evaluate("document.querySelector('#plate').focus()")
    await page.press("Enter")
    assert await contacts(era, 1) == [pytest.approx((LENGTH / 2, WIDTH / 2))]
    await page.press("ArrowRight")
    await page.press("ArrowUp")
    moved = pytest.approx((LENGTH / 2 + 0.005, WIDTH / 2 + 0.005))
    await asyncio.to_thread(
        wait_for, lambda: [(c.x_m, c.y_m) for c in era.status().contacts] == [moved]
    )
    await page.press("Enter")
    assert await contacts(era, 0) == []
    await page.press("Enter")
    await contacts(era, 1)
    await page.press("Tab")
    assert await contacts(era, 0) == []


CLEAR_AMID_STOP = f"""(() => {{
    const stop = new XMLHttpRequest();
    stop.open("POST", "/api/v1/stop", false);  // the page reads nothing until it has returned
    stop.setRequestHeader("Authorization", "Bearer {TOKEN}");
    stop.setRequestHeader("Content-Type", "application/json");
    stop.send("{{}}");
    document.getElementById("clear").click();
    return stop.status;
}})()"""
"""A stop that the page has not seen when its Clear is clicked; the status of the stop."""


async def test_buttons_arm_disarm_stop_and_clear(page: Page, era: Client) -> None:
    """Each is enabled when the daemon allows it; after a stop the log has the remedy.

    An empty plate says what to do first, and what this page did is said to be its own.
    """
    hint, cause = (
        f"document.querySelector('{element}').innerText" for element in ("#hint", "#cause")
    )
    enabled = (
        "['arm', 'disarm', 'clear', 'stop'].filter(id => !document.getElementById(id).disabled)"
    )
    await page.until(f"{enabled}.join()", lambda text: text == "arm,stop")
    assert await page.evaluate(WORD) == "ready"
    assert await page.evaluate(hint) == "Arm, then touch"
    await arm(page, era)
    assert await page.evaluate(WORD) == "on"
    assert await page.evaluate(hint) == "Touch the plate"
    assert (era.status().armed_by or "").startswith("dashboard (web:")
    await page.until(f"{enabled}.join()", lambda text: text == "disarm,stop")
    await page.click("#disarm")
    await until_state(era, READY)
    await page.until(f"{enabled}.join()", lambda text: text == "arm,stop")
    await arm(page, era)
    await page.click("#stop")
    await until_state(era, STOPPED)
    await page.until(f"{enabled}.join()", lambda text: text == "clear,stop")
    assert await page.evaluate(WORD) == "stopped"
    assert await page.evaluate(hint) == "Clear and arm, then touch"
    assert await page.evaluate(cause) == "stopped from this page"
    await page.until(
        "document.querySelector('#log li')?.innerText", lambda text: "era clear" in text
    )
    assert await page.evaluate(CLEAR_AMID_STOP) == 200
    await page.until("document.querySelector('#problem').textContent", lambda text: "since" in text)
    assert era.status().state == STOPPED
    button = "document.getElementById('clear')"
    await page.until(f"{button}.disabled || {button}.click()")
    await until_state(era, READY)
    assert page.complaints == []


async def test_space_bar_stops_with_any_focus(fresh: Page, era: Client) -> None:
    """It has no other effect there."""
    for focus in ("body", "#disarm", "#motion", "#log", "#plate", "#effects button"):
        await arm(fresh, era)
        await fresh.evaluate(f"document.querySelector({focus!r}).focus()")
        scrolled = await fresh.evaluate("scrollY")
        await fresh.press(" ", "Space")
        await until_state(era, STOPPED)
        assert await fresh.evaluate("document.querySelector('#motion').checked") is False, focus
        log = await fresh.evaluate("document.querySelector('#log').innerText")
        assert "disarmed by 'g" not in log, focus
        assert await fresh.evaluate("scrollY") == scrolled, focus
        await settled(fresh, era)


async def test_names_are_shown_as_text(page: Page, era: Client) -> None:
    """HTML in a name is not interpreted."""
    name = "<img src=x onerror=alert(1)><b>bold</b>"
    era.arm(name, lease_s=5)
    await page.until(f"{STATE} === 'OPERATION_ENABLED'")
    assert await page.evaluate("document.querySelector('#cause').innerText") == f"armed by '{name}'"
    assert name in await page.evaluate("document.querySelector('#log').innerText")
    assert await page.evaluate("document.querySelectorAll('img, b').length") == 0
    assert page.complaints == []


async def test_effect_button_always_finds_a_finger_of_its_page(page: Page, era: Client) -> None:
    """It plays at the newest finger, or puts one where the last one was lifted; only while armed.

    A slider sets the strength of its fingers, and a page of its own that by its name, if a number.
    """
    assert await page.until("document.querySelector('#effects button:disabled') !== null")
    await arm(page, era)
    async with fingers_down(page, PLACES[0]):
        (pressed,) = await contacts(era, 1)
        await page.until("document.querySelectorAll('.contact').length")
        await page.until("document.querySelector('[data-name=page] output')?.value === '0 dB'")
        await page.evaluate(
            "document.querySelectorAll('[data-name=page] input').forEach((slider) => {"
            " slider.value = -6; slider.dispatchEvent(new Event('input')); })"
        )
        await asyncio.to_thread(wait_for, lambda: era.status().strengths["page"] == -6)
        touches = await page.evaluate(
            "import('./connection.js').then(({ Connection }) => new Promise((done) => {"
            " const token = sessionStorage.getItem('era-haptics-token');"
            " const opened = () => seat.strength('seat 1', NaN).catch((error) =>"
            "  seat.strength('seat 1', -3).then(() => done(error.message)));"
            " const seat = new Connection(token, ['state'], { opened }, undefined, 'seat 1');"
            " }))"
        )
        assert touches == "gain_db must be a finite number, got NaN"
        assert era.status().strengths["seat 1"] == -3
        for name in ("page", "seat 1"):
            era.strength(name=name, gain_db=0)
        await page.click("#effects button")
        await page.until("document.querySelectorAll('.contact.target').length")
        assert await page.evaluate("document.querySelector('#problem').innerText") == ""
    await contacts(era, 0)
    for _ in range(3):
        await page.click("#effects button")
        await page.until(
            "document.querySelectorAll('.contact.target').length"
            " || document.querySelector('#problem').innerText"
        )
        assert await page.evaluate("document.querySelector('#problem').innerText") == ""
    (finger,) = await contacts(era, 1)
    assert math.dist(finger, pressed) < 0.001
    await contacts(era, 0)


async def test_login_needs_the_token(tab: Page, gateway: GatewayProcess, era: Client) -> None:
    """Without one it is requested; a wrong one is refused; the right one opens the page."""
    await tab.show(gateway.url)
    await tab.until("!document.querySelector('#login').hidden")
    assert await tab.evaluate("document.querySelector('#main').hidden") is True
    for token, selector in (("wrong" * 5, "#login-problem"), (TOKEN, "#main")):
        await tab.evaluate(
            f"document.querySelector('#token').value = '{token}';"
            "setTimeout(() => document.querySelector('#login button').click()); 1"
        )
        if selector == "#main":
            await tab.until("document.querySelector('#main')?.hidden === false")
        else:
            await tab.until("document.querySelector('#login-problem')?.innerText")
            door = await tab.evaluate("document.querySelector('#login').innerText")
            for command in ("era gateway", "era daemon", "era demo --dashboard"):
                assert command in door  # one of them has printed where to look
            assert await tab.evaluate(REASON) == "gateway-refused"
