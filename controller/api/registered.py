# Written by docs/generators/client_stub.py.
"""Every method of the API, by name, and those that end what plays."""

from controller.api.methods import (
    ArmParams,
    ArmResult,
    ClearParams,
    DisarmParams,
    EffectsResult,
    HelloParams,
    HelloResult,
    LayoutParams,
    LayoutResult,
    Method,
    PlayParams,
    ReloadResult,
    RenewParams,
    RenewResult,
    RequestedBy,
    StatusResult,
    StopResult,
    StrengthParams,
    StrengthResult,
    SubscribeParams,
    TouchParams,
    UnsubscribeParams,
)
from controller.api.schema import Empty

METHODS: dict[str, Method] = {
    "hello": Method(HelloParams, HelloResult, in_reserve=True),
    "status": Method(Empty, StatusResult, in_reserve=True),
    "arm": Method(ArmParams, ArmResult, needs_reply=True, is_repeated=False),
    "renew": Method(RenewParams, RenewResult),
    "disarm": Method(DisarmParams, Empty, silences=True, in_reserve=True),
    "stop": Method(RequestedBy, StopResult, is_limited=False, silences=True, in_reserve=True),
    "clear": Method(ClearParams, Empty, is_repeated=False),
    "forget": Method(RequestedBy, Empty),
    "touch": Method(TouchParams, Empty, is_limited=False),
    "layout": Method(LayoutParams, LayoutResult),
    "reload": Method(Empty, ReloadResult),
    "effects": Method(Empty, EffectsResult),
    "play": Method(PlayParams, Empty, is_repeated=False),
    "strength": Method(StrengthParams, StrengthResult),
    "subscribe": Method(SubscribeParams, Empty, over_http=False),
    "unsubscribe": Method(UnsubscribeParams, Empty, over_http=False),
}
SILENCING = frozenset(name for name, method in METHODS.items() if method.silences)
