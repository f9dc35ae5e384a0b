"""What tests of hosts share."""

import pytest

from virtual_lines import KINDS


@pytest.fixture(params=KINDS)
def wire(request: pytest.FixtureRequest) -> str:
    """Every kind of wire."""
    return str(request.param)
