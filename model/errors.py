"""The error class of the model."""


class InputError(ValueError):
    """Invalid input; the message says what, where and the remedy."""
