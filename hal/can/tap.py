"""Who wants to see every frame of a bus, and what it takes to read them again later."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:  # arms without a bus need no python-can
    import can


class Tap(Protocol):
    """Is called for each frame, within the control loop: it must neither wait nor fail."""

    def sent(self, frames: Sequence[tuple[int, bytes]], fd: bool, stamp_ns: int) -> None:
        """Take frames (id, data) that left the host together."""
        ...

    def received(self, frame: "can.Message", stamp_ns: int) -> None:
        """Take a frame that was read, with the time at which it arrived."""
        ...

    def describe(self, description: Mapping[str, Any]) -> None:
        """Take what is needed to decode the frames, in terms of JSON; it replaces what was said before."""
        ...
