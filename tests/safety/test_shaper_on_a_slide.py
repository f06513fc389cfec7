"""The shaper on an arm that is simple enough to know each answer beforehand.

Its first joint slides the tool along a straight line through the middle of the sphere, a metre per radian; the other
joints do not move the tool.
"""

import functools

import numpy as np
import pytest

from robotctl.hal.robot import Robot, load_robot
from robotctl.safety.shaper import Clip, Shaper

AXIS = np.array([0.6, 0.0, 0.8])
MIDDLE = np.array(load_robot("panda").profile.sphere.centre)
HOME = np.array([0.0, -0.4, 0.0, -2.2, 0.0, 1.9, 0.785])
REST = np.zeros(7)
ELSEWHERE = np.array([0.0, 0.1, -0.2, 0.3, -0.4, 0.5, -0.6])
"""Velocities of the joints that do not move the tool."""


class Slide:
    """The tool's geometry; it notes where it was asked."""

    def __init__(self, centre: np.ndarray = MIDDLE) -> None:
        self.centre = centre
        self.reach = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        self.jacobian = np.outer(AXIS, self.reach)
        self.asked: list[np.ndarray] = []

    def tool(self, position: np.ndarray) -> np.ndarray:
        self.asked.append(position)
        return self.at(position)

    def at(self, position: np.ndarray) -> np.ndarray:
        return self.centre + position[0] * AXIS


@functools.cache
def a_robot(*settings: str) -> Robot:
    return load_robot("panda", list(settings))


def caps(robot: Robot) -> tuple[np.ndarray, np.ndarray, float]:
    """Velocity and acceleration that the shaper may use, and its step."""
    usable = 1.0 - robot.profile.safety.cap_margin
    return usable * robot.limits.velocity, usable * robot.limits.acceleration, robot.period_ns * 1e-9


def at(offset: float) -> np.ndarray:
    position = HOME.copy()
    position[0] = offset
    return position


def along(speed: float, others: np.ndarray = REST) -> np.ndarray:
    velocity = others.copy()
    velocity[0] = speed
    return velocity


def step(robot: Robot, position, velocity, wanted, slide: Slide | None = None):
    slide = Slide() if slide is None else slide
    return Shaper(robot, slide).step(position, velocity, wanted, slide.at(position), slide.jacobian)


def step_far_from_everything(robot: Robot, position, velocity, wanted):
    """A step in which no bound of the workspace is near: neither Jacobian nor predicted stop is looked at."""
    slide = Slide()
    shaped = Shaper(robot, slide).step(position, velocity, wanted, slide.at(position), None)
    assert slide.asked == []
    return shaped


# -- velocity and acceleration -------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_no_joint_is_let_over_its_usable_velocity(sign):
    robot = a_robot()
    cap, _, _ = caps(robot)
    middle = 0.5 * (robot.limits.lower + robot.limits.upper)
    wanted = sign * (cap + 1e-6)
    shaped = step_far_from_everything(robot, middle * [0, 1, 1, 1, 1, 1, 1], sign * cap, wanted)
    assert shaped.velocity == pytest.approx(sign * cap, rel=1e-12)
    assert shaped.clip is Clip.VELOCITY
    granted = step_far_from_everything(robot, middle * [0, 1, 1, 1, 1, 1, 1], sign * cap, sign * cap)
    assert granted.clip is Clip.NONE


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("speed", [0.0, 0.1, -0.3])
def test_no_joint_is_let_over_its_usable_acceleration(sign, speed):
    """But the full acceleration, a rounding error more or less, is not called clipped."""
    robot = a_robot()
    _, acceleration, dt = caps(robot)
    velocity = np.full(7, speed)
    full = acceleration * dt
    granted = step_far_from_everything(robot, HOME, velocity, velocity + sign * full * (1 + 0.5e-9))
    assert granted.clip is Clip.NONE
    shaped = step_far_from_everything(robot, HOME, velocity, velocity + sign * 2.0 * full)
    assert shaped.velocity == pytest.approx(velocity + sign * full * (1 + 1e-9), rel=0, abs=1e-13)
    assert shaped.clip is Clip.POSITION


@pytest.mark.parametrize("one", range(7))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_one_joint_over_its_cap_is_called_a_velocity_clip(one, sign):
    robot = a_robot()
    cap, _, _ = caps(robot)
    wanted = 0.5 * cap
    assert step_far_from_everything(robot, HOME, REST, wanted).clip is Clip.POSITION  # in one step only
    wanted[one] = sign * (cap[one] + 1e-9)
    assert step_far_from_everything(robot, HOME, REST, wanted).clip is Clip.VELOCITY


def test_braking_takes_the_cap_off_every_speed_and_stops_at_zero():
    robot = a_robot()
    _, acceleration, dt = caps(robot)
    full = acceleration * dt
    velocity = full * [3.0, -3.0, 0.5, -0.5, 0.0, 1.0, -1.0]
    expected = full * [2.0, -2.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    assert Shaper(robot, Slide()).brake(velocity) == pytest.approx(expected, abs=1e-15)


# -- soft limits ---------------------------------------------------------------------------------------------------


def edge(robot: Robot, joint: int, side: float) -> float:
    """Where the shaper ends a joint's range, counted outwards."""
    limit = robot.limits.upper[joint] if side > 0 else -robot.limits.lower[joint]
    return limit - robot.profile.safety.position_margin


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("joint", range(1, 7))
@pytest.mark.parametrize("share", [1e-4, 0.05, 0.5, 0.999])
def test_a_joint_approaches_its_limit_just_so_fast_that_braking_ends_there(joint, side, share):
    """v dt/2 + v^2/(2 a) is the way left after this step, which begins at that speed already."""
    robot = a_robot("safety.cap_margin=0.1")
    cap, brake, dt = caps(robot)
    speed = share * cap[joint]
    position, velocity, wanted = HOME.copy(), REST.copy(), REST.copy()
    way = 0.5 * speed * dt + (0.5 * speed * dt + speed**2 / (2.0 * brake[joint]))
    position[joint] = side * (edge(robot, joint, side) - way)
    velocity[joint] = side * speed
    wanted[joint] = side * cap[joint]
    shaped = step_far_from_everything(robot, position, velocity, wanted)
    assert shaped.velocity[joint] == pytest.approx(side * speed, rel=1e-9)
    assert shaped.clip is Clip.POSITION


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("joint", range(1, 7))
def test_past_the_edge_a_joint_gets_no_further_out_and_may_come_back(joint, side):
    robot = a_robot()
    _, brake, dt = caps(robot)
    position = HOME.copy()
    position[joint] = side * (edge(robot, joint, side) + 0.01)
    outwards = REST.copy()
    outwards[joint] = side * 0.5 * brake[joint] * dt
    assert step_far_from_everything(robot, position, REST, outwards).velocity[joint] == 0.0
    back = step_far_from_everything(robot, position, REST, -outwards)
    assert back.velocity[joint] == pytest.approx(-outwards[joint])
    assert back.clip is Clip.NONE
    fast = 20.0 * outwards  # it flies out and can do nothing but brake
    shaped = step_far_from_everything(robot, position, fast, fast)
    assert shaped.velocity[joint] == pytest.approx(side * 9.0 * brake[joint] * dt)


# -- the sphere ----------------------------------------------------------------------------------------------------


def room(robot: Robot, offset: float) -> float:
    return robot.profile.sphere.radius - robot.profile.safety.sphere_margin - abs(offset)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("left", [0.1, 0.01, 1e-4])
def test_the_tool_approaches_a_bound_as_fast_as_the_room_allows(sign, left):
    robot = a_robot()
    offset = sign * (room(robot, 0.0) - left)
    allowed = sign * robot.profile.safety.sphere_gain * left
    wanted = along(allowed + sign * 1e-3, ELSEWHERE)
    shaped = step(robot, at(offset), along(allowed, ELSEWHERE), wanted)
    assert shaped.velocity == pytest.approx(along(allowed, ELSEWHERE), abs=1e-9)
    assert shaped.clip is Clip.SPHERE
    granted = step(robot, at(offset), along(allowed, ELSEWHERE), along(0.999999 * allowed, ELSEWHERE))
    assert granted.clip is Clip.NONE
    inwards = step(robot, at(offset), along(-allowed, ELSEWHERE), along(-allowed, ELSEWHERE))
    assert inwards.clip is Clip.NONE


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_slower_than_the_room_allows_nobody_has_to_look_closer(sign):
    robot = a_robot()
    offset = sign * (room(robot, 0.0) - 0.1)
    allowed = sign * robot.profile.safety.sphere_gain * 0.1
    slower = along(0.999999 * allowed, ELSEWHERE)
    assert step_far_from_everything(robot, at(offset), slower, slower).clip is Clip.NONE


def test_where_braking_cannot_keep_the_row_the_row_gives_way_and_not_the_caps():
    robot = a_robot()
    _, brake, dt = caps(robot)
    offset = room(robot, 0.0) - 0.05  # 0.25 m/s are allowed
    shaped = step(robot, at(offset), along(0.6, ELSEWHERE), along(0.6, ELSEWHERE))
    assert shaped.velocity == pytest.approx(along(0.6 - brake[0] * dt, ELSEWHERE), abs=1e-8)
    assert Clip.SPHERE in shaped.clip


def test_a_row_that_no_solver_answers_for_ends_in_braking(monkeypatch):
    robot = a_robot()
    _, brake, dt = caps(robot)
    answers = []

    def fails(*problem):
        answers.append(problem)
        return np.full(7, 7.0), 0.0, -1, {}

    monkeypatch.setattr("robotctl.safety.shaper.daqp.solve", fails)
    velocity = along(0.6, brake * dt * [0.0, 3.0, -3.0, 0.5, -0.5, 0.0, 0.0])
    shaped = step(robot, at(room(robot, 0.0) - 0.05), velocity, velocity)
    # Tried with firm rows, then with rows that daqp may soften (8), but never the caps.
    assert [senses.tolist() for *_, senses in answers] == [8 * [0], 7 * [0] + [8]]
    assert shaped.velocity == pytest.approx(Shaper(robot, Slide()).brake(velocity), abs=1e-8)


@pytest.mark.parametrize("flag", [1, 2])
def test_what_the_solver_answers_is_kept_within_the_caps_all_the_same(monkeypatch, flag):
    robot = a_robot()
    _, brake, dt = caps(robot)
    monkeypatch.setattr("robotctl.safety.shaper.daqp.solve", lambda *problem: (np.full(7, -7.0), 0.0, flag, {}))
    shaped = step(robot, at(room(robot, 0.0) - 0.05), along(0.26), along(0.26))
    assert shaped.velocity == pytest.approx(along(0.26) - brake * dt, abs=1e-8)
    monkeypatch.setattr("robotctl.safety.shaper.daqp.solve", lambda *problem: (np.full(7, 7.0), 0.0, flag, {}))
    shaped = step(robot, at(room(robot, 0.0) - 0.05), along(0.26), along(0.26))
    assert shaped.velocity == pytest.approx(along(0.26) + brake * dt, abs=1e-8)


def test_at_the_centre_of_the_sphere_there_is_no_row():
    """Here the room is small enough for the row to be asked for in the very middle."""
    robot = a_robot("sphere.radius=0.05")
    shaped = step(robot, at(0.0), along(0.5, ELSEWHERE), along(0.5, ELSEWHERE))
    assert Clip.SPHERE not in shaped.clip


WALL = "keep_out=[{{kind: plane, name: wall, point: [{:.17g}, {:.17g}, {:.17g}], normal: [-0.6, 0, -0.8]}}]".format(
    *(MIDDLE + 0.2 * AXIS)
)


@pytest.mark.parametrize("rule", ["qp", "projection"])
def test_a_keep_out_is_approached_like_the_sphere_whatever_the_rule_for_that(rule):
    robot = a_robot(WALL, f"safety.sphere={rule}")
    offset = 0.2 - robot.profile.safety.sphere_margin - 0.05
    allowed = along(robot.profile.safety.sphere_gain * 0.05, ELSEWHERE)
    shaped = step(robot, at(offset), allowed, allowed + along(1e-3))
    assert shaped.velocity == pytest.approx(allowed, abs=1e-9)
    assert shaped.clip is Clip.KEEP_OUT
    slower = 0.999999 * allowed
    assert step_far_from_everything(robot, at(offset), slower, slower).clip is Clip.NONE


def test_the_projection_rule_takes_nothing_away_before_the_tool_would_leave():
    robot = a_robot("safety.sphere=projection")
    _, _, dt = caps(robot)
    # Just fast enough for the rule to be asked.
    velocity = along(robot.profile.safety.sphere_gain * 0.05 + 1e-3, ELSEWHERE)
    shaped = step(robot, at(room(robot, 0.05)), velocity, velocity)
    assert shaped.velocity is velocity
    assert shaped.clip is Clip.NONE
    leaving = along(1e-3, ELSEWHERE)
    shaped = step(robot, at(room(robot, 0.5e-3 * dt)), leaving, leaving)
    assert Clip.SPHERE in shaped.clip
    assert shaped.velocity == pytest.approx(along(0.0, ELSEWHERE), abs=1e-8)


# -- the predicted stop --------------------------------------------------------------------------------------------

SLUGGISH = "joints.0.acceleration=0.2"
"""Now the way to rest is long, and matters before the row does."""


def way_to_rest(robot: Robot, speed: float) -> float:
    """From the beginning of a step at constant speed."""
    _, brake, dt = caps(robot)
    return speed * dt + speed**2 / (2.0 * brake[0])


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("left", "brakes"), [(1e-6, False), (-1e-6, True)])
def test_a_step_from_which_braking_would_end_outside_is_not_made(sign, left, brakes):
    robot = a_robot(SLUGGISH)
    _, brake, dt = caps(robot)
    speed = 0.3
    velocity = along(sign * speed, ELSEWHERE)
    offset = sign * (room(robot, 0.0) - way_to_rest(robot, speed) - left)
    assert robot.profile.safety.sphere_gain * room(robot, offset) > speed  # the row has no objection
    shaped = step(robot, at(offset), velocity, velocity)
    if brakes:
        assert shaped.velocity == pytest.approx(Shaper(robot, Slide()).brake(velocity))
        assert shaped.velocity[0] == pytest.approx(sign * (speed - brake[0] * dt))
        assert shaped.clip is Clip.PREDICTED_STOP
    else:
        assert shaped.velocity is velocity
        assert shaped.clip is Clip.NONE


@pytest.mark.parametrize(("left", "brakes"), [(1e-6, False), (-1e-6, True)])
def test_one_bound_that_would_be_passed_is_enough(left, brakes):
    """The wall is; the sphere is near, too, but would not be."""
    robot = a_robot(SLUGGISH, WALL)
    offset = 0.2 - robot.profile.safety.sphere_margin - way_to_rest(robot, 0.4) - left
    assert room(robot, offset) < way_to_rest(robot, 0.4)
    shaped = step(robot, at(offset), along(0.4, ELSEWHERE), along(0.4, ELSEWHERE))
    assert (Clip.PREDICTED_STOP in shaped.clip) is brakes


def test_as_long_as_the_way_to_rest_is_free_anyhow_it_is_not_looked_at():
    robot = a_robot(SLUGGISH)
    speed = 0.3
    velocity = along(speed, ELSEWHERE)
    offset = room(robot, 0.0) - way_to_rest(robot, speed) - 1e-9
    step_far_from_everything(robot, at(offset), velocity, velocity)


def test_the_way_to_rest_is_sampled_at_four_times():
    """Every joint brakes at its cap and then waits for the slowest, here the first."""
    robot = a_robot(SLUGGISH)
    _, brake, dt = caps(robot)
    velocity, following = along(0.3, ELSEWHERE), along(0.2997, ELSEWHERE + 1e-3)
    position = at(room(robot, 0.0) - 0.9 * way_to_rest(robot, 0.3))
    slide = Slide()
    step(robot, position, velocity, following, slide)
    rest = np.abs(following) / brake
    assert rest.argmax() == 0
    assert len(slide.asked) == 4
    for asked, share in zip(slide.asked, (0.25, 0.5, 0.75, 1.0), strict=True):
        expected = position + 0.5 * dt * (velocity + following)
        for joint in range(7):
            time = min(share * rest[0], rest[joint])
            expected[joint] += following[joint] * time - 0.5 * np.sign(following[joint]) * brake[joint] * time**2
        assert asked == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(("further", "brakes"), [(0.9e-9, False), (1.1e-9, True)])
@pytest.mark.parametrize("depth", [0.0, 0.004])
def test_a_tool_outside_gets_no_further_out(depth, further, brakes):
    """A nanometre is rounding. The row, which would lead it back, knows of no way: the Jacobian is singular."""
    robot = a_robot("sphere.centre=[0, 0, 0]")
    _, _, dt = caps(robot)
    position, velocity = at(room(robot, 0.0) + depth), along(further / dt)
    slide = Slide(np.zeros(3))
    shaped = Shaper(robot, slide).step(position, velocity, velocity, slide.at(position), np.zeros((3, 7)))
    assert (Clip.PREDICTED_STOP in shaped.clip) is brakes
    assert shaped.velocity == pytest.approx(REST if brakes else velocity, abs=1e-12)


def test_of_two_bounds_that_are_near_one_that_is_passed_is_enough():
    """The tool comes from the sphere's surface, inwards, towards a wall."""
    speed = 0.1
    offset = -(room(a_robot(), 0.0) - 1e-3)
    stand = offset + way_to_rest(a_robot(SLUGGISH), speed) + a_robot().profile.safety.sphere_margin - 1e-6
    x, y, z = (float(value) for value in MIDDLE + stand * AXIS)
    robot = a_robot(SLUGGISH, f"keep_out=[{{kind: plane, name: a, point: [{x}, {y}, {z}], normal: [-0.6, 0, -0.8]}}]")
    shaped = step(robot, at(offset), along(speed), along(speed))
    assert shaped.clip is Clip.PREDICTED_STOP
