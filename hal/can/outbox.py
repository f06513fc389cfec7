"""Frames that were sent and have not left: held back, taken back, and shown to be gone before anything else is sent.

A controller that nobody acknowledges repeats its oldest frame for ever, and the others wait behind it. Neither closing
the socket nor the end of the process drops them: when the drives' power returns they go out back to back, and an arm
would do what it was told before it was stopped. So what waits is taken back while the power is still off; and before
drives are spoken to again, one harmless request has to be the first frame that leaves, and to be acknowledged.
"""

from collections.abc import Collection
from typing import Protocol

import can

from robotctl.hal.clock import Clock
from robotctl.hal.errors import BusError

PROOF_TIMEOUT_S = 0.05
"""Time that a request has to leave. 0.2 ms on a sound bus; a busy one of 64 waiting frames takes 10 ms."""

_POLL_NS = 500_000


class Witness(Protocol):
    """Sees which frames have left, and what arrives, from the moment it was made."""

    def recv(self, timeout: float | None = None) -> can.Message | None: ...

    def shutdown(self) -> None: ...


class Outbox(Protocol):
    """What a channel knows of frames between `send` and the wire."""

    def waiting(self) -> bool:
        """Return whether a frame that was sent through this channel has not left. Takes a microsecond."""
        ...

    def purge(self) -> None:
        """Take back everything that waits, whoever sent it.

        Raises:
            BusError: if that was not possible, with what a person has to do.
        """
        ...

    def witness(self) -> Witness:
        """Return a new witness.

        Raises:
            BusError: if it cannot be opened.
        """
        ...


class Request(Protocol):
    """Sends a request that moves nothing, and returns whether the host took it."""

    def __call__(self, arbitration_id: int, data: bytes) -> bool: ...


def prove_empty(
    outbox: Outbox, request: Request, probe: tuple[int, bytes], commands: Collection[int], clock: Clock
) -> None:
    """Send a probe (id, data), and return once it has left as the first of our frames. Waits PROOF_TIMEOUT_S at most.

    Args:
        outbox: of the channel.
        request: sends the probe.
        probe: a request that moves nothing, on the highest id there is: controllers send lower ones first.
        commands: the ids on which drives are told to do something.
        clock: the transport's.

    Raises:
        BusError: if the probe was not acknowledged, and was taken back again; or if another frame left before it.
    """
    witness = outbox.witness()
    try:
        request(*probe)
        stale = _frames_before(witness, probe, commands, clock)
    finally:
        witness.shutdown()
    if stale is None:
        outbox.purge()
        raise BusError(
            "nobody acknowledges: a request did not leave the host, and was taken back",
            "check motor power, the emergency stop, cable and termination, and the bit rates",
        )
    if stale:
        ids = ", ".join(f"0x{identifier:03X}" for identifier in sorted(set(stale)))
        raise BusError(
            f"{len(stale)} frames that were not sent now have reached the drives, on {ids}: old ones that waited, or "
            "those of another program",
            "look at the arm, end other programs on this bus, then try again",
        )


def _frames_before(
    witness: Witness, probe: tuple[int, bytes], commands: Collection[int], clock: Clock
) -> list[int] | None:
    """Return the ids of the commands that left before the probe; None if the probe has not left in time."""
    stale: list[int] = []
    deadline = clock.now_ns() + round(PROOF_TIMEOUT_S * 1e9)
    while True:
        message = witness.recv(0.0)
        if message is None:
            now = clock.now_ns()
            if now >= deadline:
                return None
            clock.sleep_until(min(now + _POLL_NS, deadline))
        elif not message.is_error_frame:
            if (message.arbitration_id, bytes(message.data)) == probe:
                return stale
            if message.arbitration_id in commands:
                stale.append(message.arbitration_id)
