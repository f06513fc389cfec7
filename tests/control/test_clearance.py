"""Whole sessions in lockstep: links stay apart, judged on the plant's true pose by measuring every pair."""

import numpy as np
import pytest

from robotctl.control.collision import CollisionModel
from robotctl.control.kinematics import Kinematics
from robotctl.control.loop import Verb
from robotctl.control.session import LockstepSession, Stopped
from robotctl.hal.robot import Robot, load_robot
from robotctl.safety.machine import State
from robotctl.safety.region import regions
from robotctl.safety.shaper import Clip
from robotctl.safety.target import JointVelocity

TOLERANCE = 1e-3
"""Published: how far below `proximity_stop` plus `proximity_margin` the true clearance may be, m."""
LAGGING = ["twin.lag_s=0.02", "twin.noise_position=1e-4"]


class Fold:
    """Brings links together: the six nearest pairs in turn, from a new start every three seconds."""

    def __init__(self, robot: Robot, scene: CollisionModel, seed: int) -> None:
        self._cap, self._scene, self._rng = robot.limits.velocity, scene, np.random.default_rng(seed)

    def act(self, step: int, position: np.ndarray) -> np.ndarray:
        if step % 60 == 0:
            self._apart = self._rng.uniform(-1.0, 1.0, len(position)) * self._cap
            self._pair = None
        if step % 60 < 8:
            return self._apart
        if self._pair is None:
            self._pair = int(self._rng.choice(np.argsort(self._scene.clearances(position))[:6]))
        slope = self._scene.approach(position, [self._pair])[0]
        return 2.0 * self._cap * np.where(np.abs(slope) > 0.02, np.sign(slope), self._rng.choice([-0.5, 0.5]))


class Random:
    """Velocities up to ten times the caps, for half a second each."""

    def __init__(self, robot: Robot, scene: CollisionModel, seed: int) -> None:
        self._cap, self._rng = robot.limits.velocity, np.random.default_rng(seed)

    def act(self, step: int, position: np.ndarray) -> np.ndarray:
        if step % 10 == 0:
            self._wish = self._rng.uniform(-10.0, 10.0, len(position)) * self._cap
        return self._wish


@pytest.mark.parametrize(
    ("policy", "settings", "seed"),
    [(Fold, [], 1), (Fold, LAGGING, 2), (Random, LAGGING, 3)],
    ids=["fold", "fold-lagging", "random-lagging"],
)
def test_no_policy_brings_links_too_near(robot: Robot, policy: type, settings: list[str], seed: int) -> None:
    robot = load_robot(robot.profile.name, settings)
    scene = CollisionModel(robot, Kinematics(robot))
    acting = policy(robot, scene, seed)
    with LockstepSession(robot, "sim") as session:
        session.prepare()
        session.begin()
        for step in range(120):
            record = session.latest()
            deadline = session.clock.now_ns() + 100_000_000
            wish = acting.act(step, record["position"])
            session.link.mailbox.put(JointVelocity(wish, int(record["epoch"]), step, deadline))
            session.advance(0.05)
        assert session.trips == []
        records, _, _ = session.link.ticks.since(0)
    running = records[records["state"] == State.RUN]
    lowest = min(float(scene.clearances(pose).min()) for pose in running["true_position"])
    safety = robot.profile.safety
    assert lowest > safety.proximity_stop + safety.proximity_margin - TOLERANCE
    if policy is Fold:
        assert lowest < safety.proximity_slow
        assert (running["clip"] & Clip.PROXIMITY).any()


def test_an_arm_that_wakes_too_near_to_something_may_only_retreat() -> None:
    robot = load_robot("panda")
    kinematics = Kinematics(robot)
    scene = CollisionModel(robot, kinematics)
    rng = np.random.default_rng(4)
    near = np.array(robot.profile.home)
    sphere = regions(robot.profile, 0.02)[0]
    while not 0.0 < scene.clearances(near).min() < 0.004 or sphere.room(kinematics.tool(near)) < 0.0:
        near = rng.uniform(robot.limits.lower + 0.1, robot.limits.upper - 0.1)
    with LockstepSession(robot, "sim") as session:
        session._rig.arm._plant.place(near)
        session.request(Verb.ARM)
        session.advance(0.01)
        assert session.latest()["clip"] & Clip.RECOVERY
        with pytest.raises(Stopped):
            session.begin()
        session.reset(Verb.RETREAT)
        assert not session.latest()["clip"] & Clip.RECOVERY
        assert scene.clearances(session.latest()["true_position"]).min() > robot.profile.safety.proximity_stop
        assert session.trips == []
