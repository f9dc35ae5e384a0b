"""Renewal of the lease that a Python client holds while its `armed` block runs."""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path

from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.link import LeaseLost, Unreachable, make_params
from controller.api.methods import ArmResult, StatusResult
from controller.api.schema import ApiMessage, headline

LEASE_ENDED = (ErrorCode.LEASE, ErrorCode.WRONG_STATE)
"""Codes of the errors that a request with a lease causes once that lease has ended."""

_INTERVAL = 0.25  # s; bounds the time until a lost lease is noticed


class LeaseRenewal:
    """Renews a lease by a task, from its creation until the lease is lost or `end` is called.

    request: sends a request to the daemon, reconnecting if necessary. status: returns the daemon's
    status, for the cause of a loss. stopped: called when the renewal stops. path: the daemon's
    socket, for errors. Nothing arms again: a lease ended by the daemon is lost.
    """

    def __init__(
        self,
        lease: ArmResult,
        *,
        request: Callable[[str, ApiMessage], Awaitable[object]],
        status: Callable[[], Awaitable[StatusResult]],
        stopped: Callable[[], None],
        path: Path,
    ) -> None:
        self.token = lease.lease
        self.is_ended = False
        """Whether `end` was called before the lease was lost."""
        self._duration = lease.lease_s
        self._request = request
        self._status = status
        self._path = path
        self._task = asyncio.create_task(self._renew(), name="lease")  # returns the loss
        self._task.add_done_callback(lambda _: stopped())

    def end(self) -> None:
        """Stop renewing, unless the lease is lost."""
        if not self._task.done():
            self.is_ended = True
            self._task.cancel()

    def check(self) -> None:
        """Raise LeaseLost once the lease is lost."""
        if self._task.done() and not self.is_ended:
            raise self._task.result().with_traceback(None)

    async def loss(self, reason: RpcError | Unreachable) -> LeaseLost:
        """Return the loss of the lease, with the daemon's cause if the daemon rejected it."""
        if isinstance(reason, RpcError):
            with suppress(RpcError, Unreachable):
                status = await self._status()
                return LeaseLost(headline(status.state, status.cause))
        return LeaseLost(str(reason))

    async def _renew(self) -> LeaseLost:
        """Renew the lease until it is lost, and return the loss.

        While no daemon responds, retries until the lease expires.
        """
        loop = asyncio.get_running_loop()
        params = make_params("renew", lease=self.token)
        no_response = Unreachable.at(self._path, TimeoutError())
        expires_at = loop.time() + self._duration
        reason: RpcError | Unreachable = no_response
        while loop.time() < expires_at:
            await asyncio.sleep(min(_INTERVAL, expires_at - loop.time()))
            sent_at = loop.time()
            try:
                async with asyncio.timeout_at(expires_at):
                    await self._request("renew", params)
            except TimeoutError:
                break
            except (RpcError, Unreachable) as error:
                reason = error
                if isinstance(error, RpcError) and error.code is not ErrorCode.BUSY:
                    break
            else:
                expires_at = sent_at + self._duration
                reason = no_response
        return await self.loss(reason)
