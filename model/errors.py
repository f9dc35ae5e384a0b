"""The one error the model raises on purpose."""


class InputError(ValueError):
    """Input that cannot be used; the message says what, where and what to do about it."""
