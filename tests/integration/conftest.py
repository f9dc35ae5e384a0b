"""The browser of the tests of pages."""

from collections.abc import AsyncIterator

import pytest
import pytest_asyncio

from processes.gateways import Browser, Page, open_browser


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def browser(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Browser]:
    """A browser for all tests of a module."""
    async with open_browser(tmp_path_factory.mktemp("profile")) as browser:
        yield browser


@pytest_asyncio.fixture(loop_scope="module")
async def tab(browser: Browser) -> AsyncIterator[Page]:
    """A fresh tab."""
    async with browser.open_page() as page:
        yield page
