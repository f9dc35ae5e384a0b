"""Valid parameters of every method of the API, for tests that call all of them."""

from collections.abc import Mapping

API_PARAMETERS: Mapping[str, Mapping[str, object]] = {
    "hello": {"client": "me"},
    "status": {},
    "arm": {"owner": "me", "lease_s": 5},
    "renew": {"lease": "a-lease"},
    "disarm": {},
    "stop": {},
    "clear": {},
    "touch": {"source": "me", "touches": [{"id": 1, "x_m": 0.1, "y_m": 0.2}]},
    "effects": {},
    "play": {"effect": "tap", "x_m": 0.1, "y_m": 0.2},
    "strength": {"name": "page", "gain_db": -6},
    "layout": {"name": "home"},
    "reload": {},
    "subscribe": {"topics": ["state"]},
    "unsubscribe": {"topics": ["state"]},
}
