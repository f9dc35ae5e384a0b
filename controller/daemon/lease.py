"""The arming lease: one at a time, renewed by its owner or expired."""

import secrets
from dataclasses import dataclass, replace

from controller.api.jsonrpc import ErrorCode, RpcError


@dataclass(frozen=True)
class Lease:
    """A lease; token: proves ownership; duration [s]: from each renewal; expires_at [s]."""

    owner: str
    token: str
    duration: float
    expires_at: float


class LeaseHolder:
    """Holds the current lease; times [s] are arguments."""

    def __init__(self) -> None:
        self._lease: Lease | None = None

    def current(self, now: float) -> Lease | None:
        """The lease that has not expired, or None."""
        return self._lease if self._lease and now < self._lease.expires_at else None

    def is_granted(self, token: str) -> bool:
        """Whether a lease was granted and has not been ended, even if it has expired."""
        return self._lease is not None and self._lease.token == token

    @property
    def expires_at(self) -> float | None:
        """When the lease expires unless renewed [s]; None without a lease."""
        return self._lease.expires_at if self._lease else None

    def grant(self, owner: str, *, duration: float, now: float) -> Lease:
        """Grant a new lease; raises RpcError while another is current."""
        current = self.current(now)
        if current is not None:
            raise RpcError(
                ErrorCode.LEASE,
                f"armed by {current.owner!a} for {current.expires_at - now:.1f} s more",
                remedy="wait, or disarm first: every client may",
            )
        self._lease = Lease(owner, secrets.token_hex(16), duration, now + duration)
        return self._lease

    def restart(self, token: str, *, now: float) -> Lease:
        """Restart the granted lease, even if it has expired; raises RpcError if it was ended."""
        if self._lease is None or not self.is_granted(token):
            raise RpcError(ErrorCode.LEASE, "lease was ended meanwhile", remedy="arm again")
        self._lease = replace(self._lease, expires_at=now + self._lease.duration)
        return self._lease

    def renew(self, token: str, *, now: float) -> Lease:
        """Renew the current lease; raises RpcError if it has expired or is not the caller's."""
        return self.restart(self.check(token, now=now).token, now=now)

    def check(self, token: str, *, now: float) -> Lease:
        """The current lease; raises RpcError if it has expired or is not the caller's."""
        current = self.current(now)
        if current is None:
            raise RpcError(ErrorCode.LEASE, "lease has expired", remedy="arm again")
        if not secrets.compare_digest(current.token.encode(), token.encode()):
            raise RpcError(
                ErrorCode.LEASE,
                f"lease belongs to {current.owner!a}",
                remedy="wait until it expires, or disarm first: every client may",
            )
        return current

    def end(self) -> None:
        """End the lease."""
        self._lease = None
