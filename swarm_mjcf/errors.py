"""Errors that a person can cause and mend; the command line prints them as one line and exits with 2."""


class SwarmError(Exception):
    """Something given is wrong, or a file or folder cannot be used. The message says what, and what next."""


class SpecError(SwarmError, ValueError):
    """A field of a frozen specification is out of range.

    Attributes: `field`, `given` and `allowed` (a phrase) say which field, what was given and what would be accepted.
    """

    def __init__(self, field: str, given: object, allowed: str) -> None:
        super().__init__(f"{field}: {given!r} was given, allowed is {allowed}")
        self.field, self.given, self.allowed = field, given, allowed
