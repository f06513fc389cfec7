"""The soak: millions of ticks in lockstep under hostile policies, and what came of the invariants.

Every robot, in velocity and in torque mode, under each policy: random, outward, bang-bang, and a search that looks for
what breaks the limits. Whatever stops the arm is acknowledged, as its operator would, and counted.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from multiprocessing import get_context
from typing import Any

import numpy as np

from robotctl.control.operator import Verb
from robotctl.control.session import LockstepSession, Stopped
from robotctl.hal.robot import load_robot
from robotctl.hal.types import Vector
from robotctl.safety.machine import State
from robotctl.safety.shaper import Clip
from robotctl.safety.target import JointTorque, JointVelocity
from robotctl.safety.trip import Protection
from robotctl.sim.plant import Plant
from robotctl.trials.bench import plant_behind
from robotctl.trials.policies import EXCESS, Act, bang_bang, outward, random
from robotctl.trials.search import Search

MODES = ("velocity", "torque")
POLICIES = ("random", "outward", "bang-bang", "search")
POLICY_S = 0.05
_EPISODE_S = 20.0
"""Time after which the arm goes home again."""
_ATTEMPT_S = 2.0
_VALID_NS = 100_000_000
_GUARD = frozenset({"P1", "P2", "P6", "P7", "P16", "P21"})
_LOWERING_S = 2.5
_SETTLE_S = 0.2
_PIECE = 250_000
"""Ticks of one job: short enough that all cores are busy to the end."""


@dataclass(frozen=True, slots=True)
class Case:
    """One robot in one mode under one policy."""

    robot: str
    mode: str
    policy: str
    backend: str
    ticks: int
    seed: int


def cases(robots: Sequence[str], ticks: int, backend: str = "sim", seed: int = 0) -> Iterator[Case]:
    """Share `ticks` evenly over all robots, modes and policies, in jobs of a bearable size."""
    combinations = list(product(robots, MODES, POLICIES))
    each = -(-ticks // len(combinations))
    for piece in range(-(-each // _PIECE)):
        left = min(_PIECE, each - piece * _PIECE)
        for robot, mode, policy in combinations:
            yield Case(robot, mode, policy, backend, left, seed + piece)


def soak(jobs: Sequence[Case], processes: int) -> Iterator[dict[str, Any]]:
    """Run cases side by side and yield the result of each as it ends."""
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        for future in as_completed([pool.submit(run, case) for case in jobs]):
            yield future.result()


def run(case: Case) -> dict[str, Any]:
    """Run one case, and return its counts and the largest excess over each limit (negative: that far inside)."""
    with LockstepSession(load_robot(case.robot), case.backend) as session:
        soaker, ended = _Soaker(session, case), ""
        try:
            soaker.run()
        except Stopped as error:
            ended = error.what
        soaker.closest()
        trips = Counter(trip["protection"] for trip in session.trips)
        return {
            "robot": case.robot,
            "mode": case.mode,
            "policy": case.policy,
            "ticks": session.statistics.ticks,
            "judged": session.judge.judged,
            "violations": dict(session.judge.violations),
            "worst": soaker.worst,
            "trips": dict(trips),
            "freed": soaker.freed,
            "guard_trips": sum(trips[protection] for protection in _GUARD),
            "ended": ended,
            "ended_by": session.trips[-1]["text"] if ended and session.trips else "",
        }


def put_action(session: LockstepSession, mode: str, seq: int, action: Vector) -> None:
    """Ask for an action (n,) in -1..1, in a mode of `MODES`: more than the velocity caps, or all of the torque caps."""
    stamp = (int(session.latest()["epoch"]), seq, session.clock.now_ns() + _VALID_NS)
    limits, mailbox = session.robot.limits, session.link.mailbox
    if mode == "velocity":
        mailbox.put(JointVelocity(EXCESS * action * limits.velocity, *stamp))
    else:
        mailbox.put(JointTorque(action * limits.torque, *stamp))


class _Soaker:
    def __init__(self, session: LockstepSession, case: Case) -> None:
        self._session = session
        self._case = case
        self._robot = session.robot
        self._rng = np.random.default_rng(case.seed)
        self._search = Search(self._robot.dof, self._rng) if case.policy == "search" else None
        self._act = self._policy()
        self._seq = 0
        self.freed = 0
        """How often the arm could not get home by itself."""
        self.worst: dict[str, float] = {}
        """Largest excess over each limit so far; negative: that far inside."""

    def run(self) -> None:
        """Let the policy work, episode after episode, until the ticks are used up."""
        session = self._session
        session.prepare()
        while session.statistics.ticks < self._case.ticks:
            session.begin()
            self._episode()
            self._recover()

    def _episode(self) -> None:
        session = self._session
        begun = attempted = session.clock.now_ns()
        while session.state is State.RUN and session.statistics.ticks < self._case.ticks:
            now = session.clock.now_ns()
            if (now - begun) * 1e-9 > _EPISODE_S:
                break
            if self._search is not None and (now - attempted) * 1e-9 > _ATTEMPT_S:
                self._search.judge(self.closest())
                attempted = now
            record = session.latest()
            self._seq += 1
            put_action(session, self._case.mode, self._seq, self._act((now - attempted) * 1e-9, record["position"]))
            session.advance(POLICY_S)

    def _recover(self) -> None:
        """Do what an operator does: acknowledge and go home, back inside first where that is asked for.

        Raises:
            Stopped: where acknowledging does not help, as after a refusal of the guard.
        """
        session = self._session
        if session.state is State.RUN:
            session.request(Verb.STOP)
        if session.wait_for(State.HOLD, State.FAULT, timeout_s=10.0) is State.FAULT:
            if self._robot.profile.category0 == "damp":
                with suppress(Stopped):  # it is lowered first
                    session.request(Verb.ACK)
                session.advance(_LOWERING_S)
            session.request(Verb.ACK)
            session.prepare()
            return
        session.request(Verb.ACK)
        session.advance(self._robot.period_ns * 1e-9)
        if session.latest()["clip"] & Clip.RECOVERY:
            session.reset(Verb.RETREAT)
        try:
            session.reset()
        except Stopped:
            if session.trips[-1]["protection"] != Protection.RESET.label:
                raise
            self._free()

    def _free(self) -> None:
        """Lead the arm home by hand, its drives off, where no straight way leads there, and set it up again."""
        session = self._session
        session.request(Verb.ACK)
        session.request(Verb.DISARM)
        session.wait_for(State.READY, timeout_s=10.0)
        plant = plant_behind(session._rig.arm)
        self._hold(plant, held=True)
        plant.place(np.array(self._robot.profile.home))
        session.advance(_SETTLE_S)
        session.request(Verb.ARM)
        self._hold(plant, held=False)
        self.freed += 1
        session.reset()

    def _hold(self, plant: Plant, *, held: bool) -> None:
        for axis in range(self._robot.dof):
            plant.jam(axis, jammed=held)

    def closest(self) -> float:
        """Return how close to any limit the arm came since the last call, as a share of what would be far past it."""
        judge = self._session.judge
        scale = {"position": 1e-2, "velocity": 1e-1, "sphere": 1e-2, "keep_out": 1e-2}
        closest = max(value / scale[key] for key, value in judge.worst.items())
        for key, value in judge.worst.items():
            self.worst[key] = max(self.worst.get(key, -np.inf), float(value))
            judge.worst[key] = -np.inf
        return float(closest)

    def _policy(self) -> Act:
        search = self._search
        if search is not None:
            return lambda time, _position: search.action(time)
        factory = {"random": random, "outward": outward, "bang-bang": bang_bang}[self._case.policy]
        return factory(self._robot, self._rng)
