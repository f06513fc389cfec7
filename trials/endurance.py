"""A long run on a bad bus: in lockstep on emulated drives, where a share of all frames is lost, late or doubled.

None of it is a reason to stop an arm, so every stop counts as one too many; and neither memory nor descriptors may
grow.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from robotctl.control.operator import Verb
from robotctl.control.session import LockstepSession
from robotctl.hal.robot import Robot
from robotctl.safety.machine import State
from robotctl.sim.motors.drive import Reply
from robotctl.sim.motors.trouble import Trouble
from robotctl.trials.bench import emulated_buses
from robotctl.trials.policies import random
from robotctl.trials.soak import POLICY_S, put_action

LATE_S = 0.005
"""Longest delay of a late reply: it comes after those to the next two commands."""

WARM_UP = 20_000
"""Ticks before memory is looked at first: caches and rings fill."""

GROWTH_MB = 10.0
"""What resident memory may grow by after that, however long the run: the allocator's own unrest."""

_LOOK_EVERY = 10_000
"""Ticks."""
_SETTLE_S = 0.05
_PAGE = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True, kw_only=True)
class BadBus(Trouble):
    """Frames go wrong in either direction: a command is lost; a reply is lost, late, or comes twice."""

    share: float
    """Of all frames."""
    dice: Random

    def hears(self, random: Random) -> bool:
        return self.dice.random() >= self.share

    def alter(self, replies: Sequence[Reply], random: Random) -> Sequence[Reply]:
        return [fate for reply in replies for fate in self._fates(reply)]

    def _fates(self, reply: Reply) -> list[Reply]:
        if self.dice.random() >= self.share:
            return [reply]
        match self.dice.randrange(3):
            case 0:
                return []
            case 1:
                return [reply._replace(stamp_ns=reply.stamp_ns + int(LATE_S * self.dice.random() * 1e9))]
            case _:
                return [reply, reply]


def endure(
    robot: Robot,
    ticks: int,
    share: float = 0.01,
    seed: int = 0,
    on_look: Callable[[dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Let a random policy move a robot for so many ticks, or until something stops it.

    Args:
        robot: one with CAN drives.
        ticks: servo periods in state RUN.
        share: of all frames that go wrong.
        seed: of policy and trouble.
        on_look: called with `ticks`, `rss_mb` and `descriptors` now and then.

    Returns:
        Counts, every stop, violations of limits, and the looks: resident memory in MB, open descriptors.
    """
    looks: list[dict[str, Any]] = []
    rng = np.random.default_rng(seed)
    act = random(robot, rng)
    with LockstepSession(robot, "can") as session:
        buses = emulated_buses(session._rig.arm)
        buses[0].bench.plant.place(np.array(robot.profile.home))
        session.advance(_SETTLE_S)
        session.prepare()
        session.begin()
        trouble = BadBus(share=share, dice=Random(seed))
        for bus in buses:
            bus.bench.trouble.add(trouble)
        begun, done, seq = session.statistics.ticks, 0, 0
        while done < ticks and session.state is State.RUN:
            seq += 1
            put_action(session, "velocity", seq, act(session.clock.now_ns() * 1e-9, session.latest()["position"]))
            session.advance(POLICY_S)
            done = session.statistics.ticks - begun
            if done >= WARM_UP + len(looks) * _LOOK_EVERY:
                looks.append(_look(done))
                if on_look is not None:
                    on_look(looks[-1])
        for bus in buses:
            bus.bench.trouble.remove(trouble)
        session.bring_to_rest(Verb.DISARM)
        statistics = session.bus_statistics() or {}
        stops = [f"{trip['protection']}: {trip['text']}" for trip in session.trips]
        violations = dict(session.judge.violations)
    return {
        "robot": robot.profile.name,
        "ticks": done,
        "simulated_s": round(done * robot.period_ns * 1e-9, 1),
        "share": share,
        "seed": seed,
        "frames": {key: statistics[key] for key in ("sent", "received", "missed_replies")},
        "stops": stops,
        "violations": violations,
        "rss_growth_mb": round(looks[-1]["rss_mb"] - looks[0]["rss_mb"], 1) if looks else 0.0,
        "descriptor_growth": looks[-1]["descriptors"] - looks[0]["descriptors"] if looks else 0,
        "looks": looks,
    }


def drifts(result: dict[str, Any]) -> bool:
    """Return whether memory or descriptors grew over a run of `endure`."""
    return bool(result["rss_growth_mb"] > GROWTH_MB or result["descriptor_growth"] > 0)


def _look(ticks: int) -> dict[str, Any]:
    resident = int(Path("/proc/self/statm").read_text().split()[1]) * _PAGE
    descriptors = sum(1 for _ in Path("/proc/self/fd").iterdir())
    return {"ticks": ticks, "rss_mb": round(resident / 1e6, 1), "descriptors": descriptors}
