"""What a tick leaves behind in shared memory: its record, and events for what changed."""

import numpy as np

from robotctl.control.motion import Motion
from robotctl.control.shared import Link
from robotctl.hal.clock import Clock
from robotctl.hal.types import Sample, Truth, Vector
from robotctl.safety.machine import State
from robotctl.safety.shaper import Clip
from robotctl.safety.supervisor import Supervisor
from robotctl.safety.trip import Protection

_AT_HAND = frozenset({Protection.DEADMAN, Protection.ESTOP, Protection.OPERATOR})
"""Stops by a person, or for want of one: nobody has to be called for them."""


class Publisher:
    """Writes the records and events of one loop."""

    def __init__(self, link: Link, clock: Clock, dof: int) -> None:
        self._link = link
        self._clock = clock
        self._ticks = 0
        self._reported = 0
        self._state = State.OFF
        self._warning = ""
        nothing = np.zeros(dof)
        self._no_truth = Truth(nothing, nothing, nothing, np.zeros(3))

    def log(self, text: str, now_ns: int) -> None:
        """Write a line for people."""
        self._link.events.write({"type": "log", "stamp_ns": now_ns, "text": text})

    def page(self, text: str, now_ns: int) -> None:
        """Call for the operator, who may not be looking: a reset ended in a stop."""
        self._link.events.write({"type": "page", "stamp_ns": now_ns, "text": text})

    def warn(self, text: str, now_ns: int) -> None:
        """Write a line for people when there is something new to warn of; "" is nothing."""
        if text and text != self._warning:
            self.log(f"warning: {text}", now_ns)
        self._warning = text

    def report(self, supervisor: Supervisor, now_ns: int) -> None:
        """Write an event for every new trip, and one if the state changed."""
        if supervisor.state is self._state and self._reported == len(supervisor.trips):
            return
        events = self._link.events
        for trip in supervisor.trips[self._reported :]:
            if self._state is State.RESET and trip.protection not in _AT_HAND:
                self.page(f"{trip.protection.label}: {trip.cause}", now_ns)
            events.write(
                {
                    "type": "trip",
                    "stamp_ns": now_ns,
                    "protection": trip.protection.label,
                    "stop_category": int(trip.category),
                    # The stop's first command has just been sent.
                    "reaction_ms": round((self._clock.now_ns() - trip.onset_ns) / 1e6, 3),
                    "text": trip.cause,
                }
            )
        self._reported = len(supervisor.trips)
        if supervisor.state is not self._state:
            text = f"{self._state.name} -> {supervisor.state.name}"
            events.write({"type": "state", "stamp_ns": now_ns, "state": supervisor.state.name, "text": text})
            self._state = supervisor.state

    def record(
        self,
        supervisor: Supervisor,
        motion: Motion,
        sample: Sample,
        tool: Vector,
        truth: Truth | None,
        lateness_ns: int,
        now_ns: int,
    ) -> None:
        """Write the record of a tick that began at `now_ns`, and make it visible."""
        ring, command = self._link.ticks, motion.command
        clip = motion.clip | Clip.RECOVERY if supervisor.recovery else motion.clip
        true = truth or self._no_truth
        ring.fill(
            self._ticks,
            (
                self._ticks,
                now_ns,
                lateness_ns,
                supervisor.epoch,
                supervisor.admission.seq,
                supervisor.state,
                clip,
                truth is not None,
            ),
            (
                sample.position,
                sample.velocity,
                sample.effort,
                motion.wanted,
                command.position,
                command.velocity,
                command.effort,
                tool,
                true.position,
                true.velocity,
                true.tool,
            ),
        )
        ring.publish(self._ticks, self._clock.now_ns() - now_ns)
        self._ticks += 1
