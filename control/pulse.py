"""Whether somebody is still alive, seen from a counter that moves as long as they are."""

_OWN_SLEEP_NS = 20_000_000
"""Longest time between two looks that counts: whoever slept longer cannot tell who else did."""


class Pulse:
    """How long a sign of life has stayed the same."""

    def __init__(self) -> None:
        self._sign: object = None
        self._silent_ns = 0
        self._looked_ns = 0

    def silence_ns(self, sign: object, now_ns: int) -> int:
        """Return for how long `sign` has been what it is, by the looks taken at it."""
        if sign == self._sign:
            self._silent_ns += min(now_ns - self._looked_ns, _OWN_SLEEP_NS)
        else:
            self._sign, self._silent_ns = sign, 0
        self._looked_ns = now_ns
        return self._silent_ns
