import pytest

from controller.api.jsonrpc import ErrorCode, RpcError
from controller.daemon.lease import LeaseHolder


def test_a_lease_lasts_as_long_as_it_says_from_every_renewal() -> None:
    """5 s from the grant, 5 s from the renewal, and not a moment more."""
    book = LeaseHolder()
    lease = book.grant("me", duration=5, now=100)
    assert book.current(104.999) == lease
    assert book.renew(lease.token, now=104).expires_at == 109
    assert book.current(108.999) is not None
    assert book.current(109) is None
    with pytest.raises(RpcError, match="expired") as caught:
        book.renew(lease.token, now=109)
    assert caught.value.code is ErrorCode.LEASE


def test_one_lease_at_a_time() -> None:
    """While one runs nobody else gets one; its owner is named, its token is not."""
    book = LeaseHolder()
    lease = book.grant("me", duration=5, now=0)
    with pytest.raises(RpcError, match=r"armed by 'me' for 2\.0 s more") as caught:
        book.grant("you", duration=5, now=3)
    assert lease.token not in str(caught.value)
    assert book.grant("you", duration=5, now=5).owner == "you"


@pytest.mark.parametrize("token", ["", "x", "ü" * 32])
def test_only_the_token_renews(token: str) -> None:
    """Whoever has not got the token cannot keep the plate armed, whatever is sent."""
    book = LeaseHolder()
    book.grant("me", duration=5, now=0)
    with pytest.raises(RpcError, match="belongs to 'me'"):
        book.renew(token, now=1)
    assert book.expires_at == 5


def test_a_lease_that_was_ended_is_over() -> None:
    """After a stop the old token opens nothing."""
    book = LeaseHolder()
    lease = book.grant("me", duration=5, now=0)
    book.end()
    assert (book.current(1), book.expires_at) == (None, None)
    with pytest.raises(RpcError, match="expired"):
        book.renew(lease.token, now=1)


def test_no_two_leases_share_a_token() -> None:
    """Tokens are 128 bits from the system's generator."""
    book = LeaseHolder()
    tokens = {book.grant("me", duration=1, now=2 * n).token for n in range(100)}
    assert len(tokens) == 100
    assert all(len(bytes.fromhex(token)) == 16 for token in tokens)
