"""Links stay apart on the robots themselves: references led by the shaper, and whole sessions in lockstep.

Sessions are judged on the plant's true pose. The judge always measures every pair, with a model of its own.
"""

import numpy as np
import pytest

from robotctl.control.collision import CollisionModel
from robotctl.control.kinematics import Kinematics
from robotctl.control.limiter import VelocityLimiter
from robotctl.control.loop import Verb
from robotctl.control.session import LockstepSession, Stopped
from robotctl.hal.robot import Robot, load_robot
from robotctl.hal.types import Sample
from robotctl.safety.machine import State
from robotctl.safety.proximity import Clearances
from robotctl.safety.region import regions
from robotctl.safety.routines import Retreat
from robotctl.safety.shaper import Clip, Shaper
from robotctl.safety.target import JointVelocity

TOLERANCE = 1e-3
"""Published: how far below `proximity_stop` plus `proximity_margin` the true clearance may come, m."""
MEASURED = 2e-5
"""What GJK may be wrong by, m."""
LAGGING = ["twin.lag_s=0.02", "twin.noise_position=1e-4"]


class Fold:
    """Brings links together, one of the six nearest pairs at a time, from a new start every three seconds."""

    def __init__(self, robot: Robot, scene: CollisionModel, seed: int) -> None:
        self._cap, self._scene, self._rng = robot.limits.velocity, scene, np.random.default_rng(seed)

    def act(self, step: int, position: np.ndarray) -> np.ndarray:
        if step % 60 == 0:
            self._apart = self._rng.uniform(-1.0, 1.0, len(position)) * self._cap
        if step % 60 < 8:
            return self._apart
        if step % 60 == 8:
            self._pair = int(self._rng.choice(np.argsort(self._scene.clearances(position))[:6]))
        slope = self._scene.approach(position, [self._pair])[0]
        return 2.0 * self._cap * np.where(np.abs(slope) > 0.02, np.sign(slope), self._rng.choice([-0.5, 0.5]))


class Bang:
    """Ten times the caps, either way, for half a second each."""

    def __init__(self, robot: Robot, scene: CollisionModel, seed: int) -> None:
        self._cap, self._rng = robot.limits.velocity, np.random.default_rng(seed)

    def act(self, step: int, position: np.ndarray) -> np.ndarray:
        if step % 10 == 0:
            self._wish = self._rng.choice([-10.0, 0.0, 10.0], len(position)) * self._cap
        return self._wish


class Reference:
    """What the loop does to a reference: limit, shape, integrate."""

    def __init__(self, robot: Robot, scene: CollisionModel | None, start: np.ndarray | None = None) -> None:
        self.kinematics = Kinematics(robot)
        self.position = np.array(robot.profile.home if start is None else start)
        self.velocity, self.acceleration = np.zeros(robot.dof), np.zeros(robot.dof)
        self.clip = Clip.NONE
        self._limiter, self._shaper = VelocityLimiter(robot), Shaper(robot, self.kinematics, scene)
        self._dt = robot.period_ns * 1e-9

    def step(self, wish: np.ndarray) -> None:
        limited = self._limiter.step(wish, self.velocity, self.acceleration)
        tool, jacobian = self.kinematics.tool_and_jacobian(self.position)
        following, clip = self._shaper.step(self.position, self.velocity, limited, tool, jacobian)
        self.acceleration = (following - self.velocity) / self._dt
        self.position = self.position + 0.5 * self._dt * (self.velocity + following)
        self.velocity = following
        self.clip |= clip


def model_of(robot: Robot) -> CollisionModel:
    return CollisionModel(robot, Kinematics(robot))


def pose_with_clearance(robot: Robot, scene: CollisionModel, least: float, most: float, rng) -> np.ndarray:
    pose = rng.uniform(robot.limits.lower + 0.1, robot.limits.upper - 0.1)
    while not least < scene.clearances(pose).min() < most:
        pose = rng.uniform(robot.limits.lower + 0.1, robot.limits.upper - 0.1)
    return pose


def among_posts(robot: Robot) -> str:
    """The setting for two thin posts and a wall around the home of an arm, clear of it by some centimetres."""
    x, y, z = (round(float(value), 3) for value in Kinematics(robot).tool(np.array(robot.profile.home)))
    items = [
        f"{{kind: box, name: left, centre: [{x}, {y + 0.25}, {z}], half: [0.01, 0.01, 0.4], rpy: [0.2, 0, 0]}}",
        f"{{kind: box, name: right, centre: [{x}, {y - 0.25}, {z}], half: [0.01, 0.01, 0.4], rpy: [0, 0.3, 0]}}",
        f"{{kind: plane, name: wall, point: [{x + 0.2}, 0, 0], normal: [-1, 0.2, 0.1]}}",
    ]
    return f"keep_out=[{', '.join(items)}]"


# -- references -----------------------------------------------------------------------------------------------------


def test_the_answers_are_those_of_measuring_everything(robot: Robot) -> None:
    """500 poses on 20 motions, half of which begin near: never late, and few pairs need measuring."""
    scene, judge = model_of(robot), model_of(robot)
    measured, measure = [], scene.measure
    scene.measure = lambda position, pairs: measured.extend(pairs) or measure(position, pairs)
    watch = Clearances(scene)
    rng = np.random.default_rng(3)
    short = 0
    for motion in range(20):
        pose = pose_with_clearance(robot, judge, 0.0, 0.025 if motion % 2 else 9.0, rng)
        velocity = rng.uniform(-1.0, 1.0, robot.dof) * robot.limits.velocity
        for _ in range(25):
            pose = pose + 0.002 * velocity
            bounds, truth = watch.at(pose[np.newaxis], 0.02)[0], judge.clearances(pose)
            assert (bounds <= truth + MEASURED).all()
            assert ((bounds < 0.02) == (truth < 0.02))[np.abs(truth - 0.02) > MEASURED].all()
            short += int((truth < 0.02).sum())
    assert short > 0
    assert len(measured) - short < 0.15 * 500 * len(scene.pairs)


@pytest.mark.parametrize(("policy", "posts"), [(Fold, False), (Fold, True), (Bang, True)])
def test_hostile_wishes_bring_no_pair_too_near(robot: Robot, policy: type, posts: bool) -> None:
    if posts:
        robot = load_robot(robot.profile.name, [among_posts(robot)])
    judge, reference, safety = model_of(robot), Reference(robot, model_of(robot)), robot.profile.safety
    acting, lowest = policy(robot, judge, 7), np.inf
    for tick in range(6000):
        if tick % 25 == 0:
            wish = acting.act(tick // 25, reference.position)
        reference.step(wish)
        assert (np.abs(reference.acceleration) <= robot.limits.acceleration).all()
        lowest = min(lowest, float(judge.clearances(reference.position).min()))
    assert lowest > safety.proximity_stop + safety.proximity_margin - 5e-4
    assert lowest < safety.proximity_slow  # else nothing was tested
    assert Clip.PROXIMITY in reference.clip


@pytest.mark.parametrize("watched", [True, False])
def test_an_elbow_is_kept_out_where_the_tool_is_far_away(watched: bool) -> None:
    """The elbow swings about the line from shoulder to tool, against a beam at its side; the tool stays."""
    beam = "{kind: box, name: beam, centre: [-0.05, 0.28, 0.6], half: [0.3, 0.02, 0.02]}"
    robot = load_robot("panda", [f"keep_out=[{beam}]"])
    scene = model_of(robot)
    reference = Reference(robot, scene if watched else None)
    kinematics, clearances = reference.kinematics, []
    for tick in range(1500):
        if tick % 25 == 0:
            swing = np.linalg.svd(kinematics.pose_and_jacobian(reference.position)[1])[2][-1]
            wish = 0.8 * swing * np.sign(swing[2])
        reference.step(wish)
        clearances.append(float(scene.clearances(reference.position).min()))
        assert regions(robot.profile)[1].room(kinematics.tool(reference.position)) > 0.25
    if watched:
        assert 0.0075 < min(clearances) < 0.010
    else:
        assert min(clearances) < -0.02


def test_a_retreat_brings_links_apart(robot: Robot) -> None:
    """From poses with links too near to each other or overlapping, also outside the sphere, to where they may be."""
    scene, rng = model_of(robot), np.random.default_rng(9)
    keeps = robot.profile.safety.proximity_stop + robot.profile.safety.proximity_margin
    for _ in range(2):
        start = pose_with_clearance(robot, scene, -0.01, 0.004, rng)
        reference = Reference(robot, scene, start)
        routine = Retreat(robot, reference.kinematics, scene)
        lowest = [scene.clearances(start).min()]
        for _ in range(round(routine.timeout_s * robot.profile.servo_hz)):
            zeros = np.zeros(robot.dof)
            sample = Sample(0, reference.position, reference.velocity, zeros, zeros.astype(int), enabled=True)
            wish = routine.velocity(sample, reference.position)
            if wish is None:
                break
            assert (np.abs(wish) <= 0.1 * robot.limits.velocity * (1 + 1e-9)).all()
            reference.step(wish)
            lowest.append(scene.clearances(reference.position).min())
        assert wish is None
        assert lowest[-1] > keeps + 1e-3
        assert min(np.diff(lowest)) > -1e-4


# -- sessions -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("policy", "settings", "seed"),
    [(Fold, [], 1), (Fold, LAGGING, 2), (Bang, LAGGING, 3)],
    ids=["fold", "fold-lagging", "bang-lagging"],
)
def test_no_policy_brings_links_too_near(robot: Robot, policy: type, settings: list[str], seed: int) -> None:
    robot = load_robot(robot.profile.name, settings)
    scene, safety = model_of(robot), robot.profile.safety
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
    assert lowest > safety.proximity_stop + safety.proximity_margin - TOLERANCE
    if policy is Fold:
        assert lowest < safety.proximity_slow
        assert (running["clip"] & Clip.PROXIMITY).any()


def test_an_arm_that_wakes_too_near_to_something_may_only_retreat(panda: Robot) -> None:
    kinematics, scene, rng = Kinematics(panda), model_of(panda), np.random.default_rng(4)
    near = pose_with_clearance(panda, scene, 0.0, 0.004, rng)
    while regions(panda.profile, 0.02)[0].room(kinematics.tool(near)) < 0.0:
        near = pose_with_clearance(panda, scene, 0.0, 0.004, rng)
    with LockstepSession(panda, "sim") as session:
        session._rig.arm._plant.place(near)
        session.request(Verb.ARM)
        session.advance(0.01)
        assert session.latest()["clip"] & Clip.RECOVERY
        with pytest.raises(Stopped):
            session.begin()
        session.reset(Verb.RETREAT)
        assert not session.latest()["clip"] & Clip.RECOVERY
        assert scene.clearances(session.latest()["true_position"]).min() > panda.profile.safety.proximity_stop
        assert session.trips == []
