"""Who has armed, and for how long: one lease at a time, renewed by its owner or over."""

import secrets
from dataclasses import dataclass, replace

from controller.api.jsonrpc import ErrorCode, RpcError


@dataclass(frozen=True)
class Lease:
    """token: what its owner proves it with; lasts [s] from every renewal; ends [s]."""

    owner: str
    token: str
    lasts: float
    ends: float


class LeaseBook:
    """Keeps the lease; reads no clock, so every question says what time [s] it is."""

    def __init__(self) -> None:
        self._lease: Lease | None = None

    def held(self, now: float) -> Lease | None:
        """The lease that runs."""
        return self._lease if self._lease and now < self._lease.ends else None

    @property
    def ends(self) -> float | None:
        """When [s] the lease is over unless it is renewed; None where there is none."""
        return self._lease.ends if self._lease else None

    def grant(self, owner: str, *, lasts: float, now: float) -> Lease:
        """A new lease; raises RpcError while another runs."""
        held = self.held(now)
        if held is not None:
            raise RpcError(
                ErrorCode.LEASE,
                f"armed by {held.owner!a} for {held.ends - now:.1f} s more",
                remedy="wait, or disarm first: anyone may",
            )
        self._lease = Lease(owner, secrets.token_hex(16), lasts, now + lasts)
        return self._lease

    def begin(self, token: str, *, now: float) -> Lease:
        """The lease that was granted, as long as it lasts from now on, also if it was over by then.

        Raises RpcError where it was ended.
        """
        if self._lease is None or self._lease.token != token:
            raise RpcError(ErrorCode.LEASE, "the lease was ended meanwhile", remedy="arm again")
        self._lease = replace(self._lease, ends=now + self._lease.lasts)
        return self._lease

    def renew(self, token: str, *, now: float) -> Lease:
        """The same lease from now on; raises RpcError where it is over, or another's."""
        held = self.held(now)
        if held is None:
            raise RpcError(
                ErrorCode.LEASE, "the lease is over: nothing is armed by it", remedy="arm again"
            )
        if not secrets.compare_digest(held.token.encode(), token.encode()):
            raise RpcError(
                ErrorCode.LEASE,
                f"the lease that runs belongs to {held.owner!a}, not to you",
                remedy="wait until it is over, or disarm first: anyone may",
            )
        return self.begin(held.token, now=now)

    def end(self) -> None:
        """No lease runs any more."""
        self._lease = None
