"""Valid parameters and results of the methods of the API, for tests that call all of them."""

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

API_RESULTS: Mapping[str, Mapping[str, object]] = {
    "renew": {"lease_s": 5.0},
    "layout": {"layout": "home", "layouts": ["home"]},
    "reload": {"reloaded": True, "reasons": []},
}
"""Results of a scripted daemon; methods without a row have no required results."""
