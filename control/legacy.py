"""The rings of a loop whose process is gone, continued by the watchman: recordings and reports hold what came of it."""

import os
import select
from contextlib import suppress

from robotctl.control.shared import Link
from robotctl.hal.clock import Clock
from robotctl.hal.types import Command, Sample, Vector
from robotctl.safety.machine import State
from robotctl.safety.trip import Category, Protection


class Legacy:
    """Goes on from the last record. Rings have one writer each, so the loop's process must be gone for good."""

    def __init__(self, link: Link, clock: Clock) -> None:
        """Take the rings.

        Raises:
            ValueError: if the loop has not left a single record.
        """
        record = link.ticks.latest()
        if record is None:
            raise ValueError("a loop without a tick leaves nothing")
        self._link = link
        self._clock = clock
        self._record = record

    @property
    def position(self) -> Vector:
        """Where the joints were measured last (n,), rad."""
        position: Vector = self._record["position"]
        return position

    @property
    def stamp_ns(self) -> int:
        """When the last tick began."""
        return int(self._record["stamp_ns"])

    def trip(self, cause: str, onset_ns: int) -> None:
        """Tell of P27, category 0, in the ring and aloud. To be called once the first command has been sent."""
        now = self._clock.now_ns()
        protection = Protection.WATCHMAN.label
        self._record["epoch"] += 1
        self._link.events.write(
            {
                "type": "trip",
                "stamp_ns": now,
                "protection": protection,
                "stop_category": int(Category.CUT),
                "reaction_ms": round((now - onset_ns) / 1e6, 3),
                "text": cause,
            }
        )
        sound(f"{protection}: {cause}")

    def log(self, text: str) -> None:
        """Write a line for people."""
        self._link.events.write({"type": "log", "stamp_ns": self._clock.now_ns(), "text": text})

    def tick(self, state: State, sample: Sample | None = None, command: Command | None = None) -> None:
        """Leave a record: the last one, with what is known anew."""
        record = self._record
        record["tick"] += 1
        record["stamp_ns"] = self._clock.now_ns()
        record["state"] = state
        record["lateness_ns"] = record["duration_ns"] = record["clip"] = 0
        record["wanted"] = 0.0
        if sample is not None and command is not None:
            record["position"], record["velocity"], record["effort"] = sample.position, sample.velocity, sample.effort
            record["command_position"], record["command_velocity"] = command.position, command.velocity
            record["command_effort"] = command.effort
        self._link.ticks.append(record)


def sound(text: str) -> None:
    """Ring the terminal's bell and say what happened on stderr, if that takes it without waiting."""
    bell = "\a" if os.isatty(2) else ""
    ready = select.poll()
    ready.register(2, select.POLLOUT)
    if any(events & select.POLLOUT for _, events in ready.poll(0)):
        with suppress(OSError):  # whoever listened is gone
            os.write(2, f"{bell}robotctl: {text}\n".encode())
