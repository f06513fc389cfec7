"""P20 on clearances that are known; on robots it is judged in tests/control/test_clearance.py."""

import functools

import numpy as np
import pytest

from robotctl.hal.robot import Robot, load_robot
from robotctl.hal.types import Sample
from robotctl.safety.machine import Event, State
from robotctl.safety.proximity import Clearances, NothingNear, ProximityBreach, ProximityLimit
from robotctl.safety.region import Row
from robotctl.safety.routines import Retreat
from robotctl.safety.shaper import Clip, Shaper
from robotctl.safety.supervisor import Supervisor
from robotctl.safety.trip import Category, Protection

STAMP = 7_000_000
STEPS = [-1e-3, -1e-6, -1e-9, 0.0, 1e-9, 1e-6, 1e-3, 1.0]
STOP, MARGIN, SLOW, GAIN = 0.005, 0.003, 0.020, 5.0


@functools.cache
def a_robot(*settings: str) -> Robot:
    return load_robot("panda", list(settings))


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


def sample(position: np.ndarray, velocity: np.ndarray) -> Sample:
    return Sample(0, position, velocity, velocity, np.zeros(len(position), np.int64), enabled=True)


# -- bounds ---------------------------------------------------------------------------------------------------------


def test_a_pair_is_measured_again_only_once_its_clearance_may_be_used_up() -> None:
    scene = Lines()
    watch = Clearances(scene)
    first = watch.at(np.zeros((1, 2)), 0.05)[0]
    assert first == pytest.approx([0.1, 0.2, 0.3])
    assert sorted(scene.measured) == [0, 1, 2]
    # 49 mm of 50 to spare; going away counts like coming near, since only the pose is known.
    for way in (0.025, 0.049, 0.0):
        bounds = watch.at(np.array([[-way, 0.0]]), 0.05)[0]
    assert len(scene.measured) == 3 + 1
    assert (bounds <= clearances([0.0, 0.0]) + 1e-12).all()
    watch = Clearances(scene)
    watch.at(np.zeros((1, 2)), 0.05)
    scene.measured.clear()
    assert watch.at(np.array([[0.0499, 0.0]]), 0.05)[0, 0] == pytest.approx(0.0501)
    assert scene.measured == []
    assert watch.at(np.array([[0.0501, 0.0]]), 0.05)[0, 0] == pytest.approx(0.0499)
    assert scene.measured == [0]


def test_every_pose_and_every_pair_has_its_own_bound_and_threshold() -> None:
    scene = Lines()
    watch = Clearances(scene)
    watch.at(np.zeros((2, 2)), 0.0)
    scene.measured.clear()
    poses = np.array([[0.0, 0.0], [0.06, 0.0]])
    bounds = watch.at(poses, np.array([0.05, 0.0, 0.0]))
    assert scene.measured == [0]
    assert bounds[0] == pytest.approx([0.1, 0.2, 0.3])
    assert bounds[1] == pytest.approx([0.04, 0.2, 0.27])


def test_enough_is_enough() -> None:
    scene = Lines()
    watch = Clearances(scene)
    watch.at(np.zeros((1, 2)), 0.1)
    scene.measured.clear()
    watch.at(np.zeros((1, 2)), 0.1)
    assert scene.measured == []  # exactly enough
    watch.at(np.zeros((1, 2)), np.nextafter(0.1, 1.0))
    assert scene.measured == [0]


def test_a_pose_that_is_no_number_is_measured_and_not_remembered() -> None:
    scene = Lines()
    watch = Clearances(scene)
    watch.at(np.zeros((1, 2)), 0.05)
    assert np.isnan(watch.at(np.array([[np.nan, 0.0]]), 0.05)).any()
    assert watch.at(np.zeros((1, 2)), 0.05)[0] == pytest.approx([0.1, 0.2, 0.3])


def test_the_caller_may_reuse_its_array() -> None:
    watch, pose = Clearances(Lines()), np.zeros((1, 2))
    watch.at(pose, 0.05)
    pose[0, 0] = 0.08
    assert watch.at(pose, 0.05)[0, 0] == pytest.approx(0.02)


# -- limit ----------------------------------------------------------------------------------------------------------


def limit() -> ProximityLimit:
    robot = a_robot(f"safety.proximity_slow={SLOW}", f"safety.proximity_margin={MARGIN}")
    return ProximityLimit(robot, Lines())


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


@pytest.mark.parametrize("which", range(3))
def test_a_path_keeps_what_is_required_at_all_of_its_poses(which: int) -> None:
    watched = limit()
    _, required = watched.look(np.zeros(2))
    assert required == pytest.approx(np.full(3, KEEPS), abs=3e-5)
    for distance, expected in ((KEEPS + 1e-6, True), (KEEPS, True), (KEEPS - 1e-4, False), (-0.5, False)):
        path = np.full((3, 2), [0.1 - KEEPS, 0.0])  # all other poses are as near as may be
        path[which, 0] = 0.1 - distance
        assert watched.keeps(path, required) is expected


@pytest.mark.parametrize(("room", "travel", "expected"), [(0.0, 0.0019, True), (0.0, 0.0021, False)])
@pytest.mark.parametrize("spare", [0.0, 0.01])
@pytest.mark.parametrize("reverse", [False, True])
def test_between_two_poses_a_pair_may_fall_a_millimetre_short(room, travel, expected, spare, reverse) -> None:
    """The third pair is as near at both, but might be nearer in between by half of what it can move."""
    watched = limit()
    required = np.full(3, KEEPS)
    middle = np.full(2, 0.3 - KEEPS - room - spare)
    apart = (travel + 2.0 * spare) * np.array([0.5, -0.5])
    scene = watched._scene
    scene.offsets = np.array([9.0, 9.0, 0.3])
    path = np.array([middle - apart, middle + apart])
    path = path[::-1] if reverse else path
    assert scene.measure(path[0], [2]) == pytest.approx(KEEPS + room + spare)
    assert np.abs(np.diff(path, axis=0)) @ scene.reach[2] == pytest.approx(travel + 2.0 * spare)
    assert watched.keeps(path, required) is expected
    scene.measured.clear()
    watched.keeps(path, required)
    assert scene.measured == ([] if expected else [2, 2])


@pytest.mark.parametrize(("spare", "expected"), [(0.0061, True), (0.0059, False)])
@pytest.mark.parametrize("order", [[0, 1, 2], [0, 2, 1], [1, 2, 0], [2, 1, 0]])
def test_every_two_poses_in_a_row_count(order: list[int], spare: float, expected: bool) -> None:
    """One pose far away, one with some clearance to spare, one with none; 8 mm lie between these two."""
    watched, middle = limit(), np.full(2, 0.3 - KEEPS)
    watched._scene.offsets = np.array([9.0, 9.0, 0.3])
    poses = np.array([middle - 0.05, middle - spare, middle + np.array([0.008, -0.008])])
    assert watched._scene.reach[2] @ np.abs(poses[2] - poses[1]) == pytest.approx(0.008)
    assert watched.keeps(poses[order], np.full(3, KEEPS)) is expected


@pytest.mark.parametrize("ends", [slice(None), slice(None, None, -1)])
def test_no_path_is_refused_for_what_was_measured_elsewhere(ends: slice) -> None:
    """The bounds of the first path leave the second enough at its poses, but not between the two that lie apart."""
    watched, required = limit(), np.full(3, KEEPS)
    watched._scene.offsets = np.array([9.0, 9.0, 0.3])
    middle, aside = np.full(2, 0.3 - KEEPS - 0.03), np.array([1.0, -1.0])
    path = np.array([middle - 0.02 * aside, middle + 0.02 * aside, middle + 0.021 * aside])[ends]
    assert watched.keeps(path + 0.02 * aside, required)
    assert watched.keeps(path, required)


def test_a_pair_that_is_too_near_may_get_no_nearer() -> None:
    watched = limit()
    here = np.array([0.098, 0.0])
    _, required = watched.look(here)
    assert required == pytest.approx([0.002, KEEPS, KEEPS], abs=3e-5)
    assert watched.keeps(np.array([here, here]), required)
    assert watched.keeps(np.array([here, [0.097, 0.0]]), required)
    assert not watched.keeps(np.array([here, [0.0981, 0.0]]), required)


@pytest.mark.parametrize(("left", "expected"), [(1e-9, True), (-1e-9, False)])
def test_a_way_that_is_short_enough_is_clear_wherever_it_leads(left: float, expected: bool) -> None:
    watched, required = limit(), np.array([0.01, 0.02, 0.03])
    position, way = np.array([0.02, -0.01]), np.array([0.03, 0.01])
    watched._scene.offsets = required + np.abs(Lines.slopes) @ way + Lines.slopes @ position + [1.0, left, 1.0]
    assert watched.clear(position, way, required) is expected


def test_nothing_is_near_where_there_is_no_geometry(panda: Robot) -> None:
    scene = NothingNear(7)
    watched = ProximityLimit(panda, scene)
    rows, required = watched.look(np.zeros(7))
    assert rows == []
    assert scene.reach.shape == (0, 7)
    assert watched.clear(np.zeros(7), np.ones(7), required)
    assert watched.keeps(np.full((5, 7), 3.0), required)
    assert ProximityBreach(panda, scene).check(np.zeros(7), STAMP) is None
    assert len(scene.measure(np.zeros(7), range(0))) == len(scene.approach(np.zeros(7), range(0))) == 0


# -- breach ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("stop", [0.005, 0.012])
def test_a_measured_clearance_below_the_threshold_stops_the_arm(stop: float, step: float) -> None:
    robot = a_robot(f"safety.proximity_stop={stop}", "safety.proximity_slow=0.05")
    scene = Lines()
    scene.slopes = np.eye(3, 2)
    scene.offsets = np.array([stop + step, 1.0, 1.0])
    trip = ProximityBreach(robot, scene).check(np.zeros(2), STAMP)
    assert (trip is not None) is (step < 0)
    if trip is not None:
        assert (trip.protection, trip.category, trip.onset_ns) == (Protection.PROXIMITY, Category.BRAKE_HOLD, STAMP)
        assert f"hand and base measured {1e3 * (stop + step):.1f} mm apart" in trip.cause


def test_the_nearest_pair_is_named() -> None:
    trip = ProximityBreach(a_robot(), Lines()).check(np.array([0.097, -0.099]), STAMP)
    assert "elbow and wall measured 2.0 mm apart; acknowledge, then retreat" in trip.cause


def test_a_measured_pose_that_is_no_number_is_never_fine() -> None:
    assert ProximityBreach(a_robot(), Lines()).check(np.array([np.nan, 0.0]), STAMP) is not None


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
        self.supervisor = Supervisor(a_robot(), FirstJoint())
        for event in (Event.CONNECT, Event.SELFTEST, Event.ARM):
            self.supervisor.handle(event)
        if state is not State.ARMED:
            self.supervisor.handle(Event.START if state is State.RUN else Event.RESET)

    def observe(self, clearance: float) -> list[tuple[Protection, Category]]:
        home = np.array(a_robot().profile.home)
        home[0] = clearance
        at_centre = np.array(a_robot().profile.sphere.centre)
        self.supervisor.admission.renew(0)
        self.supervisor.observe(sample(home, np.zeros(7)), at_centre, home, np.zeros(7), np.zeros(7), 0)
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
    home = np.array(a_robot().profile.home)
    home[0] = clearance
    tool = np.array(a_robot().profile.sphere.centre)
    watched.supervisor.begin_recovery_if_outside(sample(home, np.zeros(7)), tool)
    assert watched.supervisor.recovery is recovers


# -- shaper ---------------------------------------------------------------------------------------------------------


class Still:
    """A tool that no joint moves, in the middle of its sphere."""

    reach = np.zeros(7)

    def tool(self, position):
        return np.array(a_robot().profile.sphere.centre)


class Narrow:
    """Pairs that come together by a metre per radian, as `slopes` says; the first by the first joint alone."""

    pairs = (("hand", "base"), ("elbow", "wall"))

    def __init__(self, clearances: list[float], slopes: dict[int, list[float]] | None = None) -> None:
        self.slopes = np.zeros((2, 7))
        self.slopes[0, 0] = 1.0
        for pair, slope in (slopes or {}).items():
            self.slopes[pair, :2] = slope
        self.reach = np.abs(self.slopes)
        self.offsets = np.array(clearances) + self.slopes @ HOME
        self.asked: list[np.ndarray] = []

    def measure(self, position, pairs):
        self.asked.append(position)
        return (self.offsets - self.slopes @ position)[list(pairs)]

    def approach(self, position, pairs):
        return [self.slopes[pair] for pair in pairs]


HOME = np.array(a_robot().profile.home)
KEEPS = STOP + MARGIN
ELSEWHERE = np.array([0.0, 0.1, -0.2, 0.3, -0.4, 0.5, -0.6])
"""Velocities of the joints that bring nothing together."""


def along(speed: float, others: np.ndarray = ELSEWHERE) -> np.ndarray:
    velocity = others.copy()
    velocity[0] = speed
    return velocity


def shaper(scene: Narrow, *settings: str) -> Shaper:
    return Shaper(a_robot(*settings), Still(), scene)


def step(shaper: Shaper, velocity: np.ndarray, wanted: np.ndarray):
    return shaper.step(HOME, velocity, wanted, Still().tool(HOME), np.zeros((3, 7)))


@pytest.mark.parametrize("clearance", [SLOW - 1e-6, 0.015, KEEPS + 1e-3])
def test_near_links_approach_as_fast_as_their_clearance_allows(clearance: float) -> None:
    allowed = along(GAIN * (clearance - KEEPS))
    shaped = step(shaper(Narrow([clearance, 1.0])), allowed, allowed + along(1e-3, np.zeros(7)))
    assert shaped.velocity == pytest.approx(allowed, abs=1e-8)
    assert shaped.clip is Clip.PROXIMITY
    granted = step(shaper(Narrow([clearance, 1.0])), allowed, 0.999999 * allowed)
    assert granted.clip is Clip.NONE
    apart = step(shaper(Narrow([clearance, 1.0])), -allowed, -allowed)
    assert apart.clip is Clip.NONE


def test_links_that_are_not_near_are_not_slowed() -> None:
    fast = along(2.0 * GAIN * (SLOW - KEEPS))
    assert step(shaper(Narrow([SLOW + 1e-6, 1.0])), fast, fast).velocity is fast
    assert Clip.PROXIMITY in step(shaper(Narrow([SLOW - 1e-6, 1.0])), fast, fast).clip


SLUGGISH = "joints.0.acceleration=0.2"
"""Now the way to rest is long, and matters before the row does."""


def way_to_rest(speed: float) -> tuple[float, float]:
    """Braking of the first joint, and its way from the beginning of a step at constant speed."""
    brake = (1.0 - a_robot().profile.safety.cap_margin) * 0.2
    return brake, 0.002 * speed + speed**2 / (2.0 * brake)


@pytest.mark.parametrize(("left", "brakes"), [(-1e-5, False), (-3e-5, True)])
def test_a_step_from_which_links_would_stop_too_near_is_not_made(left: float, brakes: bool) -> None:
    """Between the two lies what measurements may differ by."""
    brake, way = way_to_rest(0.3)
    shaped = step(shaper(Narrow([KEEPS + way + left, 1.0]), SLUGGISH), along(0.3), along(0.3))
    assert shaped.clip is (Clip.PREDICTED_STOP if brakes else Clip.NONE)
    assert shaped.velocity[0] == pytest.approx(0.3 - brake * 0.002 if brakes else 0.3)


@pytest.mark.parametrize(("left", "brakes"), [(-1e-5, False), (-3e-5, True)])
def test_where_any_way_of_that_length_would_be_too_long_the_way_to_rest_is_looked_at(left, brakes) -> None:
    """The pair could come together twice as fast as it does."""
    brake, way = way_to_rest(0.2)
    scene = Narrow([KEEPS + way + left, 1.0])
    scene.reach = 2.0 * scene.reach
    shaped = step(shaper(scene, SLUGGISH), along(0.2), along(0.2))
    assert shaped.clip is (Clip.PREDICTED_STOP if brakes else Clip.NONE)
    assert shaped.velocity[0] == pytest.approx(0.2 - brake * 0.002 if brakes else 0.2)
    ahead = {round(float(pose[0] - HOME[0]), 9) for pose in scene.asked}
    shares = np.arange(9) / 8.0
    expected = np.where(shares > 0.0, 0.0004 + (way - 0.0004) * (2.0 * shares - shares**2), 0.0)
    assert ahead == {round(float(value), 9) for value in expected}


def test_links_that_are_clear_anyhow_are_not_looked_at_where_the_tool_is() -> None:
    """The tool is near the bound of its sphere, and its way to rest is looked at."""

    class AtTheBound(Still):
        reach = np.full(7, 0.1)

        def tool(self, position):
            profile = a_robot().profile
            outward = profile.sphere.radius - profile.safety.sphere_margin - 1e-3
            return super().tool(position) + np.array([outward, 0.0, 0.0])

    scene = Narrow([0.5, 1.0])
    tool = AtTheBound()
    shapes = Shaper(a_robot(), tool, scene)
    assert shapes.step(HOME, along(0.2), along(0.2), tool.tool(HOME), np.zeros((3, 7))).clip is Clip.NONE
    assert len(scene.asked) == 1


def test_no_pair_is_measured_again_while_it_has_enough_to_spare() -> None:
    scene = Narrow([0.5, 1.0])
    shapes = shaper(scene)
    for _ in range(5):
        assert step(shapes, along(0.2), along(0.2)).clip is Clip.NONE
    assert len(scene.asked) == 1


@pytest.mark.parametrize(("clearance", "back"), [(0.006, 0.01), (0.0, 0.04), (-0.002, 0.05), (-0.5, 0.05)])
def test_links_that_are_too_near_are_led_apart(clearance: float, back: float) -> None:
    shaped = step(shaper(Narrow([clearance, 1.0])), along(-back), along(0.0))
    assert shaped.velocity == pytest.approx(along(-back), abs=2e-3 * back)
    assert Clip.PROXIMITY in shaped.clip
    faster = along(-back - 1e-3)
    assert step(shaper(Narrow([clearance, 1.0])), faster, faster).velocity is faster


@pytest.mark.parametrize("slope", [1.0, 0.1, 0.03, -0.03])
def test_the_less_a_joint_can_do_the_less_it_is_asked_for(slope: float) -> None:
    """Damped, since 5 cm/s at the pair would be any speed of a joint that hardly moves it."""
    scene = Narrow([-0.1, 1.0], {0: [slope, 0.0]})
    shaped = step(shaper(scene, "joints.0.acceleration=1e9"), along(0.0), along(0.0))
    assert shaped.velocity == pytest.approx(along(-0.05 * slope / (slope**2 + 1e-3)), rel=1e-6)


def test_two_pairs_that_are_too_near_are_led_apart_together() -> None:
    """The first joint would help one pair and bring the other nearer; the second helps both."""
    scene = Narrow([0.004, 0.004], {0: [1.0, 1.0], 1: [-1.0, 1.0]})
    shaped = step(shaper(scene), np.zeros(7), np.zeros(7))
    assert shaped.velocity[0] == pytest.approx(0.0, abs=1e-6)
    assert shaped.velocity[1] < -5e-3
    assert shaped.clip is Clip.PROXIMITY


def test_two_pairs_that_one_joint_cannot_both_help_stay_as_they_are() -> None:
    scene = Narrow([0.004, 0.004], {1: [-1.0, 0.0]})
    wish = along(0.0, 0.1 * ELSEWHERE)
    shaped = step(shaper(scene), wish, wish)
    assert shaped.velocity == pytest.approx(wish, abs=1e-6)


def test_a_pair_that_nothing_moves_stops_nothing() -> None:
    scene = Narrow([0.004, 1.0], {0: [0.0, 0.0]})
    wish = along(0.2)
    assert step(shaper(scene), wish, wish).velocity == pytest.approx(wish, abs=1e-9)


# -- retreat --------------------------------------------------------------------------------------------------------


class Here:
    """A tool in the middle of its sphere."""

    def tool_and_jacobian(self, position):
        return Still().tool(position), np.zeros((3, 7))


@pytest.mark.parametrize(("clearance", "apart"), [(KEEPS + 2.1e-3, False), (KEEPS + 1.9e-3, True), (-0.01, True)])
def test_a_retreat_leads_near_links_apart(clearance: float, apart: bool) -> None:
    robot = a_robot()
    wish = Retreat(robot, Here(), Narrow([1.0, clearance], {1: [0.0, 0.5]})).velocity(sample(HOME, np.zeros(7)), HOME)
    assert (wish is not None) is apart
    if apart:
        assert wish[1] < 0.0
        assert not wish[[0, 2, 3, 4, 5, 6]].any()
        assert abs(wish[1]) <= 0.1 * robot.limits.velocity[1] * (1 + 1e-9)


def test_between_three_poses_each_way_counts() -> None:
    """A way that is too long, the first or the second of two, is found by what a pair could do on it."""
    required = np.full(3, KEEPS)
    for bent in (0, 1):
        watched = limit()
        watched._scene.offsets = np.array([9.0, 9.0, 0.3])
        near = np.full(2, 0.3 - KEEPS)
        path = np.array([near, near, near])
        path[: bent + 1] += 0.0019 * np.array([1.0, -1.0])
        assert watched.keeps(path, required)
        path[: bent + 1] += 0.0002 * np.array([1.0, -1.0])
        assert not watched.keeps(path, required)


def test_a_scene_without_pairs_has_no_reach_either() -> None:
    assert NothingNear(6).reach.shape == (0, 6)
