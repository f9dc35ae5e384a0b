"""The arming lease: one at a time, renewed by its owner or expired."""

import math
import secrets
from dataclasses import dataclass, field, replace
from typing import Self

from controller.api.jsonrpc import ErrorCode, RpcError


@dataclass(frozen=True)
class Lease:
    """A lease; duration [s]: from each renewal; token: proves ownership; expires_at [s]."""

    owner: str
    duration: float
    token: str = field(default_factory=lambda: secrets.token_hex(16))
    expires_at: float = math.inf

    def renewed(self, now: float) -> Self:
        """Return it for its duration from now [s] on."""
        return replace(self, expires_at=now + self.duration)


def check_lease(lease: Lease | None, token: str, now: float) -> Lease:
    """Return a lease; raises RpcError if it has expired [s], or is not that of a token."""
    if lease is None or now >= lease.expires_at:
        raise RpcError(ErrorCode.LEASE, "lease has expired", remedy="arm again")
    if not secrets.compare_digest(lease.token.encode(), token.encode()):
        raise RpcError(
            ErrorCode.LEASE,
            f"lease belongs to {lease.owner!a}",
            remedy="wait until it expires, or disarm first: every client may",
        )
    return lease
