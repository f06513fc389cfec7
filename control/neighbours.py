"""Those who have to be there while the arm moves: the operator's process, and the watchman."""

from robotctl.control.pulse import Pulse
from robotctl.control.shared import Link
from robotctl.safety.trip import Category, Protection, Trip

_SILENCE_NS = 1_000_000_000
"""Time without a beat after which what moves is stopped."""


class Neighbours:
    """Watches their beats. One who has never shown life, as in lockstep, is not missed."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._operator = Pulse()
        self._watchman = Pulse()

    def check(self, now_ns: int) -> Trip | None:
        """Trip (category 2) for a neighbour that is suspended, blocked or gone. Asked in every tick."""
        beats, watched = self._link.desk.beats, self._link.watch.beats
        silence = self._operator.silence_ns(beats, now_ns)
        unwatched = self._watchman.silence_ns(watched, now_ns)
        if beats and silence > _SILENCE_NS:
            return self._trip(Protection.OPERATOR, "operator's process", now_ns - silence)
        if watched and unwatched > _SILENCE_NS:
            return self._trip(Protection.WATCHMAN, "watchman", now_ns - unwatched)
        return None

    def _trip(self, protection: Protection, who: str, since_ns: int) -> Trip:
        cause = f"the {who} has been silent for {_SILENCE_NS / 1e9:g} s"
        return Trip(protection, Category.BRAKE_HOLD, cause, since_ns + _SILENCE_NS)
