"""P20 by itself, on clearances that are known; then in the shaper, on robots, judged by measuring everything."""

import numpy as np
import pytest

from robotctl.control.collision import CollisionModel
from robotctl.control.kinematics import Kinematics
from robotctl.control.limiter import VelocityLimiter
from robotctl.hal.robot import Robot, load_robot
from robotctl.hal.types import Sample
from robotctl.safety.machine import Event, State
from robotctl.safety.proximity import Clearances, NothingNear, ProximityBreach, ProximityLimit
from robotctl.safety.region import Row, regions
from robotctl.safety.routines import Retreat
from robotctl.safety.shaper import Clip, Shaper
from robotctl.safety.supervisor import Supervisor
from robotctl.safety.trip import Category, Protection

STAMP = 7_000_000
STEPS = [-1e-3, -1e-6, -1e-9, 0.0, 1e-9, 1e-6, 1e-3, 1.0]
STOP, MARGIN, SLOW, GAIN = 0.005, 0.003, 0.020, 5.0


class Lines:
    """Three pairs on two joints, each clearance a straight line: d = offset - slope q."""

    pairs = (("hand", "base"), ("elbow", "wall"), ("hand", "wall"))
    slopes = np.array([[1.0, 0.0], [0.0, -2.0], [0.5, 0.5]])
    offsets = np.array([0.1, 0.2, 0.3])
    reach = np.abs(slopes)

    def __init__(self) -> None:
        self.measured: list[int] = []

    def measure(self, position, pairs):
        self.measured += pairs
        return (self.offsets - self.slopes @ position)[list(pairs)]

    def approach(self, position, pairs):
        return [self.slopes[pair] for pair in pairs]


def clearances(position) -> np.ndarray:
    return Lines.offsets - Lines.slopes @ np.asarray(position)


# -- bounds ---------------------------------------------------------------------------------------------------------


def test_a_pair_is_measured_again_only_once_its_clearance_may_be_used_up() -> None:
    scene = Lines()
    watch = Clearances(scene, 1)
    first = watch.at(np.zeros((1, 2)), 0.05)[0]
    assert first == pytest.approx([0.1, 0.2, 0.3])
    assert sorted(scene.measured) == [0, 1, 2]
    # 49 mm of 50 to spare; going away counts like coming near, since only the pose is known.
    for way in (0.025, 0.049, 0.0):
        bounds = watch.at(np.array([[-way, 0.0]]), 0.05)[0]
    assert len(scene.measured) == 3 + 1
    assert (bounds <= clearances([0.0, 0.0]) + 1e-12).all()
    watch = Clearances(scene, 1)
    watch.at(np.zeros((1, 2)), 0.05)
    scene.measured.clear()
    assert watch.at(np.array([[0.0499, 0.0]]), 0.05)[0, 0] == pytest.approx(0.0501)
    assert scene.measured == []
    assert watch.at(np.array([[0.0501, 0.0]]), 0.05)[0, 0] == pytest.approx(0.0499)
    assert scene.measured == [0]


def test_every_pose_and_every_pair_has_its_own_bound_and_threshold() -> None:
    scene = Lines()
    watch = Clearances(scene, 2)
    watch.at(np.zeros((2, 2)), 0.0)
    scene.measured.clear()
    poses = np.array([[0.0, 0.0], [0.06, 0.0]])
    bounds = watch.at(poses, np.array([0.05, 0.0, 0.0]))
    assert scene.measured == [0]
    assert bounds[0] == pytest.approx([0.1, 0.2, 0.3])
    assert bounds[1] == pytest.approx([0.04, 0.2, 0.27])


def test_enough_is_enough() -> None:
    scene = Lines()
    watch = Clearances(scene, 1)
    watch.at(np.zeros((1, 2)), 0.1)
    scene.measured.clear()
    watch.at(np.zeros((1, 2)), 0.1)
    assert scene.measured == []  # exactly enough
    watch.at(np.zeros((1, 2)), np.nextafter(0.1, 1.0))
    assert scene.measured == [0]


def test_a_pose_that_is_no_number_is_measured_and_not_remembered() -> None:
    scene = Lines()
    watch = Clearances(scene, 1)
    watch.at(np.zeros((1, 2)), 0.05)
    assert np.isnan(watch.at(np.array([[np.nan, 0.0]]), 0.05)).any()
    assert watch.at(np.zeros((1, 2)), 0.05)[0] == pytest.approx([0.1, 0.2, 0.3])


def test_the_caller_may_reuse_its_array() -> None:
    watch, pose = Clearances(Lines(), 1), np.zeros((1, 2))
    watch.at(pose, 0.05)
    pose[0, 0] = 0.08
    assert watch.at(pose, 0.05)[0, 0] == pytest.approx(0.02)


def test_the_answers_are_those_of_measuring_everything(robot: Robot) -> None:
    """500 poses on 20 motions, some of which begin near: never late, and most pairs need no measuring."""
    scene, judge = (CollisionModel(robot, Kinematics(robot)) for _ in range(2))
    measured, measure = [], scene.measure
    scene.measure = lambda position, pairs: measured.extend(pairs) or measure(position, pairs)
    watch = Clearances(scene, 1)
    rng = np.random.default_rng(3)
    short = 0
    for motion in range(20):
        pose = rng.uniform(robot.limits.lower, robot.limits.upper)
        while motion % 2 and not 0.0 < judge.clearances(pose).min() < 0.025:
            pose = rng.uniform(robot.limits.lower, robot.limits.upper)
        velocity = rng.uniform(-1.0, 1.0, robot.dof) * robot.limits.velocity
        for _ in range(25):
            pose = pose + 0.002 * velocity
            bounds, truth = watch.at(pose[np.newaxis], 0.02)[0], judge.clearances(pose)
            assert (bounds <= truth + 2e-5).all()
            assert ((bounds < 0.02) == (truth < 0.02))[np.abs(truth - 0.02) > 2e-5].all()
            short += int((truth < 0.02).sum())
    assert short > 0
    assert len(measured) - short < 0.15 * 500 * len(scene.pairs)


# -- limit ----------------------------------------------------------------------------------------------------------


def limit(samples: int = 2) -> ProximityLimit:
    robot = load_robot("panda", [f"safety.proximity_slow={SLOW}", f"safety.proximity_margin={MARGIN}"])
    return ProximityLimit(robot, Lines(), samples)


def same(row: Row, normal, bound) -> bool:
    return row.normal == pytest.approx(normal) and row.bound == pytest.approx(bound)


def test_pairs_that_are_near_get_a_row_and_others_none() -> None:
    for distance in (0.2, SLOW + 1e-9, SLOW):
        assert limit().look(np.array([0.1 - distance, 0.0]))[0] == []
    for distance in (SLOW - 1e-9, 0.01, STOP + MARGIN):
        (row,), _ = limit().look(np.array([0.1 - distance, 0.0]))
        assert same(row, [1.0, 0.0], GAIN * (distance - STOP - MARGIN))
    rows, _ = limit().look(np.array([0.09, -0.095]))
    assert same(rows[0], [1.0, 0.0], GAIN * 0.002)
    assert same(rows[1], [0.0, -2.0], GAIN * 0.002)


@pytest.mark.parametrize(("distance", "bound"), [(0.006, -0.01), (0.0, -0.04), (-0.002, -0.05), (-0.1, -0.05)])
def test_pairs_that_are_too_near_are_led_apart_but_not_fast(distance: float, bound: float) -> None:
    (row,), _ = limit().look(np.array([0.1 - distance, 0.0]))
    assert same(row, [1.0, 0.0], bound)


def test_a_path_keeps_what_is_required_at_all_of_its_poses() -> None:
    keeps = STOP + MARGIN
    watched = limit()
    _, required = watched.look(np.zeros(2))
    assert required == pytest.approx(np.full(3, keeps), abs=3e-5)
    for last in (True, False):
        for distance, expected in ((keeps + 1e-6, True), (keeps, True), (keeps - 1e-4, False), (-0.5, False)):
            path = np.array([[0.0, 0.0], [0.1 - distance, 0.0]])
            assert watched.keeps(path if last else path[::-1], required) is expected


def test_a_pair_that_is_too_near_may_get_no_nearer() -> None:
    watched = limit(1)
    _, required = watched.look(np.array([0.098, 0.0]))
    assert required == pytest.approx([0.002, STOP + MARGIN, STOP + MARGIN], abs=3e-5)
    assert watched.keeps(np.array([[0.098, 0.0]]), required)
    assert watched.keeps(np.array([[0.090, 0.0]]), required)
    assert not watched.keeps(np.array([[0.0981, 0.0]]), required)


def test_nothing_is_near_where_there_is_no_geometry(panda: Robot) -> None:
    scene = NothingNear(7)
    watched = ProximityLimit(panda, scene, 4)
    rows, required = watched.look(np.zeros(7))
    assert rows == []
    assert watched.keeps(np.full((4, 7), 3.0), required)
    assert ProximityBreach(panda, scene).check(np.zeros(7), STAMP) is None
    assert len(scene.measure(np.zeros(7), range(0))) == len(scene.approach(np.zeros(7), range(0))) == 0


# -- breach ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("stop", [0.005, 0.012])
def test_a_measured_clearance_below_the_threshold_stops_the_arm(stop: float, step: float) -> None:
    robot = load_robot("panda", [f"safety.proximity_stop={stop}", "safety.proximity_slow=0.05"])
    scene = Lines()
    scene.slopes = np.eye(3, 2)
    scene.offsets = np.array([stop + step, 1.0, 1.0])
    trip = ProximityBreach(robot, scene).check(np.zeros(2), STAMP)
    assert (trip is not None) is (step < 0)
    if trip is not None:
        assert (trip.protection, trip.category, trip.onset_ns) == (Protection.PROXIMITY, Category.BRAKE_HOLD, STAMP)
        assert f"hand and base measured {1e3 * (stop + step):.1f} mm apart" in trip.cause


def test_the_nearest_pair_is_named() -> None:
    trip = ProximityBreach(load_robot("panda"), Lines()).check(np.array([0.097, -0.099]), STAMP)
    assert "elbow and wall measured 2.0 mm apart; acknowledge, then retreat" in trip.cause


def test_a_measured_pose_that_is_no_number_is_never_fine() -> None:
    assert ProximityBreach(load_robot("panda"), Lines()).check(np.array([np.nan, 0.0]), STAMP) is not None


# -- supervisor -----------------------------------------------------------------------------------------------------


class FirstJoint:
    """One pair, as far apart as the first of seven joints says."""

    pairs = (("hand", "base"),)
    reach = np.eye(1, 7)

    def measure(self, position, pairs):
        return np.full(len(pairs), position[0])


class Watched:
    """A supervisor in some state, and what it finds."""

    def __init__(self, state: State) -> None:
        self.supervisor = Supervisor(load_robot("panda"), FirstJoint())
        for event in (Event.CONNECT, Event.SELFTEST, Event.ARM):
            self.supervisor.handle(event)
        if state is not State.ARMED:
            self.supervisor.handle(Event.START if state is State.RUN else Event.RESET)

    def observe(self, clearance: float) -> list[tuple[Protection, Category]]:
        home = np.array(load_robot("panda").profile.home)
        home[0] = clearance
        at_centre = np.array(load_robot("panda").profile.sphere.centre)
        self.supervisor.admission.renew(0)
        self.supervisor.observe(sample(home, np.zeros(7)), at_centre, home, np.zeros(7), 0)
        return [(trip.protection, trip.category) for trip in self.supervisor.trips]


@pytest.mark.parametrize("state", [State.ARMED, State.RUN, State.RESET])
def test_the_supervisor_stops_the_arm(state: State) -> None:
    assert Watched(state).observe(0.0051) == []
    assert Watched(state).observe(0.0049) == [(Protection.PROXIMITY, Category.BRAKE_HOLD)]


def test_a_retreat_is_not_stopped_for_what_it_retreats_from() -> None:
    watched = Watched(State.RESET)
    watched.supervisor.recovery = True
    assert watched.observe(0.001) == []


@pytest.mark.parametrize(("clearance", "recovers"), [(0.0051, False), (0.0049, True)])
def test_armed_too_near_the_arm_may_only_retreat(clearance: float, recovers: bool) -> None:
    watched = Watched(State.ARMED)
    home = np.array(load_robot("panda").profile.home)
    home[0] = clearance
    tool = np.array(load_robot("panda").profile.sphere.centre)
    watched.supervisor.begin_recovery_if_outside(sample(home, np.zeros(7)), tool)
    assert watched.supervisor.recovery is recovers


# -- robots ---------------------------------------------------------------------------------------------------------


def folding(robot: Robot, scene: CollisionModel, rng: np.random.Generator, position: np.ndarray) -> np.ndarray:
    """Velocities that bring one of the nearest pairs together as fast as can be."""
    pair = int(rng.choice(np.argsort(scene.clearances(position))[:6]))
    slope = scene.approach(position, [pair])[0]
    return 2.0 * robot.limits.velocity * np.where(np.abs(slope) > 0.02, np.sign(slope), rng.choice([-0.5, 0.5]))


def furnished(robot: Robot) -> str:
    """The setting for thin posts and a ceiling around the home of an arm, clear of it by some centimetres."""
    kinematics = Kinematics(robot)
    x, y, z = (round(float(value), 3) for value in kinematics.tool(np.array(robot.profile.home)))
    posts = [
        f"{{kind: box, name: left, centre: [{x}, {y + 0.25}, {z}], half: [0.01, 0.01, 0.4], rpy: [0.2, 0, 0]}}",
        f"{{kind: box, name: right, centre: [{x}, {y - 0.25}, {z}], half: [0.01, 0.01, 0.4], rpy: [0, 0.3, 0]}}",
        f"{{kind: plane, name: wall, point: [{x + 0.2}, 0, 0], normal: [-1, 0.2, 0.1]}}",
    ]
    return f"keep_out=[{', '.join(posts)}]"


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


@pytest.mark.parametrize(("policy", "around"), [("fold", "nothing"), ("fold", "posts"), ("bang", "posts")])
def test_hostile_wishes_bring_no_pair_too_near(robot: Robot, policy: str, around: str) -> None:
    """Every pair is measured at every tick, by another model than the shaper's."""
    if around == "posts":
        robot = load_robot(robot.profile.name, [furnished(robot)])
    judge = CollisionModel(robot, Kinematics(robot))
    reference = Reference(robot, CollisionModel(robot, Kinematics(robot)))
    safety, rng, wish, lowest = robot.profile.safety, np.random.default_rng(7), np.zeros(robot.dof), np.inf
    for tick in range(6000):
        if policy == "fold" and tick % 1000 == 0:
            wish = rng.uniform(-1.0, 1.0, robot.dof) * robot.limits.velocity
        elif policy == "fold" and tick % 1000 >= 300 and tick % 25 == 0:
            wish = folding(robot, judge, rng, reference.position)
        elif policy == "bang" and tick % 300 == 0:
            wish = rng.choice([-10.0, 0.0, 10.0], robot.dof) * robot.limits.velocity
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
    scene = CollisionModel(robot, Kinematics(robot))
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


def test_a_retreat_brings_a_pair_apart(robot: Robot) -> None:
    """From poses with links too near to each other or overlapping, to where the shaper would have let them go."""
    scene = CollisionModel(robot, Kinematics(robot))
    rng = np.random.default_rng(9)
    keeps = robot.profile.safety.proximity_stop + robot.profile.safety.proximity_margin
    starts = []
    while len(starts) < 3:
        pose = rng.uniform(robot.limits.lower + 0.1, robot.limits.upper - 0.1)
        if -0.01 < scene.clearances(pose).min() < 0.004:
            starts.append(pose)
    for start in starts:
        reference = Reference(robot, scene, start)
        routine = Retreat(robot, reference.kinematics, scene)
        lowest = [scene.clearances(start).min()]
        for _ in range(round(routine.timeout_s * robot.profile.servo_hz)):
            wish = routine.velocity(sample(reference.position, reference.velocity), reference.position)
            if wish is None:
                break
            assert (np.abs(wish) <= 0.1 * robot.limits.velocity * (1 + 1e-9)).all()
            reference.step(wish)
            lowest.append(scene.clearances(reference.position).min())
        assert wish is None
        assert lowest[-1] > keeps + 1e-3
        assert min(np.diff(lowest)) > -1e-4


def sample(position: np.ndarray, velocity: np.ndarray) -> Sample:
    return Sample(0, position, velocity, velocity, np.zeros(len(position), np.int64), enabled=True)
