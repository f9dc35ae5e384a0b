"""The plate as known and the plates that it may be: what fingers feel within the uncertainty."""
