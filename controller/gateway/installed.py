"""Check that the libraries of the gateway, an optional extra, are installed."""

from importlib.util import find_spec

from model.errors import InputError

_LIBRARIES = ("prometheus_client", "starlette", "uvicorn", "websockets")


def require_gateway() -> None:
    """Raise InputError if a library of the gateway is missing."""
    for name in _LIBRARIES:
        if find_spec(name) is None:
            raise InputError(
                f"the gateway needs {name}, which is not installed; "
                "install it in a checkout with  pip install -e '.[gateway]'"
            )
