"""Whether the libraries of the gateway are there: they come with an extra, not with the rest."""

from importlib.util import find_spec

from model.errors import InputError

_LIBRARIES = ("starlette", "uvicorn", "websockets")


def require_gateway() -> None:
    """Raise InputError with what to install where one of its libraries is missing."""
    for name in _LIBRARIES:
        if find_spec(name) is None:
            raise InputError(
                f"the gateway and its page need {name}, which is not installed; "
                "install it with  pip install 'era-haptics[gateway]'"
            )
