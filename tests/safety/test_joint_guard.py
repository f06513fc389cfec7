"""What the guard allows one joint: a grid of steps around every limit."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotctl.hal.robot import load_robot
from robotctl.safety.asked import EXACT, Asked, Kind, Step
from robotctl.safety.joint_guard import JointGuard
from robotctl.safety.trip import Protection

ROBOT = load_robot("panda")
JOINT, SAFETY = ROBOT.profile.joints[1], ROBOT.profile.safety
KP, KD = JOINT.gains.kp, JOINT.gains.kd
DT = 2e-3
LOWER, UPPER = JOINT.position
BRAKING = (1.0 - SAFETY.cap_margin) * JOINT.acceleration
STEP = Step(1e-4, 1e-2, 0.1, 1e-3, 0.05)
GRID = [-0.1, -0.01, -0.002, 0.002, 0.01, 0.1]
"""Shares of a limit; the guard leaves one in a thousand to rounding."""


def track(position=0.0, velocity=0.0, effort=0.0, kp=KP, kd=KD):
    return Asked.of(position, velocity, kp, kd, effort)


def guard(last=None):
    joint = JointGuard(JOINT, SAFETY)
    if last is not None:
        joint.keep(last)
    return joint


def ask(joint, asked, step=EXACT, position=0.0, velocity=0.0, seconds=DT, standing=False):
    refusal = joint.refuse(asked, step, position, velocity, seconds, standing=standing)
    return None if refusal is None else refusal.protection


def test_what_follows_the_last_message_passes():
    assert ask(guard(track(0.1, 0.2, 3.0)), track(0.1004, 0.201, 3.1)) is None
    assert ask(guard(), track()) is None


@pytest.mark.parametrize("field", Step._fields)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_refused(field, value):
    assert ask(guard(track()), track()._replace(**{field: value})) is Protection.FRAMES


@pytest.mark.parametrize("step", GRID)
@pytest.mark.parametrize("resolution", [EXACT, STEP])
def test_gains_above_the_profiles_are_refused(step, resolution):
    most = max(KD, 0.5)  # damping has a floor
    for gains in ({"kp": KP * (1.0 + step) + resolution.kp}, {"kd": most * (1.0 + step) + resolution.kd}):
        assert ask(guard(track()), track(**gains), resolution) is (Protection.FRAMES if step > 0.0 else None)


def test_damping_may_exceed_a_small_tracking_gain():
    light = ROBOT.profile.joints[6].model_copy(update={"gains": JOINT.gains.model_copy(update={"kd": 0.1})})
    joint = JointGuard(light, SAFETY)
    assert ask(joint, Asked.of(0.0, 0.0, 0.0, 0.5, 0.0)) is None
    assert ask(joint, Asked.of(0.0, 0.0, 0.0, 0.51, 0.0)) is Protection.FRAMES
    geared = light.model_copy(update={"drive": light.drive.model_copy(update={"gear": 2.0})})
    assert ask(JointGuard(geared, SAFETY), Asked.of(0.0, 0.0, 0.0, 2.0, 0.0)) is None
    assert ask(JointGuard(geared, SAFETY), Asked.of(0.0, 0.0, 0.0, 2.01, 0.0)) is Protection.FRAMES
    without = light.model_copy(update={"drive": None})
    assert ask(JointGuard(without, SAFETY), Asked.of(0.0, 0.0, 0.0, 0.1, 0.0)) is None
    assert ask(JointGuard(without, SAFETY), Asked.of(0.0, 0.0, 0.0, 0.11, 0.0)) is Protection.FRAMES


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("step", GRID)
@pytest.mark.parametrize("resolution", [EXACT, STEP])
@pytest.mark.parametrize("gains", [(KP, KD), (0.0, KD), (0.0, 0.0)])
def test_torque_above_the_cap_is_refused_in_every_mode(side, step, resolution, gains):
    effort = side * (JOINT.torque * (1.0 + step) + resolution.effort)
    asked = Asked.of(0.0, 0.0, *gains, effort)
    assert ask(guard(asked._replace(effort=side * JOINT.torque)), asked, resolution, seconds=1.0) is (
        Protection.TORQUE if step > 0.0 else None
    )


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("step", GRID)
@pytest.mark.parametrize("resolution", [EXACT, STEP])
@pytest.mark.parametrize("seconds", [DT, 3 * DT])
def test_torque_changes_no_faster_than_its_rate(side, step, resolution, seconds):
    change = side * (JOINT.torque_rate * seconds * (1.0 + step) + 2.0 * resolution.effort)
    asked = Asked.of(0.0, 0.0, 0.0, 0.0, 5.0 + change)
    assert ask(guard(asked._replace(effort=5.0)), asked, resolution, seconds=seconds) is (
        Protection.TORQUE if step > 0.0 else None
    )


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("step", GRID)
def test_feed_forward_may_jump_when_braking_sets_in_and_no_further(side, step):
    change = side * (JOINT.torque_rate * DT + SAFETY.track_step * JOINT.torque) * (1.0 + step)
    assert ask(guard(track(effort=-0.5 * change)), track(effort=0.5 * change)) is (
        Protection.TORQUE if step > 0.0 else None
    )


def test_damping_takes_its_torque_at_once():
    assert ask(guard(track(effort=-80.0)), Asked.of(0.0, 0.0, 0.0, KD, 80.0)) is None


@pytest.mark.parametrize(
    ("velocity", "refused"), [(0.0, False), (0.0099, False), (-0.0099, False), (0.0101, True), (-1.0, True)]
)
def test_damping_leads_nowhere(velocity, refused):
    assert ask(guard(track()), Asked.of(0.0, velocity, 0.0, KD, 0.0), STEP) is (Protection.FRAMES if refused else None)


def test_torque_is_not_judged_by_fields_that_have_no_effect():
    assert ask(guard(track()), Asked.of(99.0, 99.0, 0.0, 0.0, 0.0), standing=True) is None


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("step", GRID)
@pytest.mark.parametrize("resolution", [EXACT, STEP])
def test_velocity_above_the_cap_is_refused(side, step, resolution):
    velocity = side * (JOINT.velocity * (1.0 + step) + resolution.velocity)
    asked = track(velocity=velocity)
    assert ask(guard(asked), asked, resolution) is (Protection.VELOCITY if step > 0.0 else None)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("step", GRID)
@pytest.mark.parametrize("resolution", [EXACT, STEP])
@pytest.mark.parametrize("standing", [False, True])
def test_an_arm_that_is_to_stand_is_not_led(side, step, resolution, standing):
    asked = track(velocity=side * (SAFETY.standstill * (1.0 + step) + resolution.velocity))
    refused = standing and step > 0.0
    assert ask(guard(asked), asked, resolution, standing=standing) is (Protection.FRAMES if refused else None)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("step", GRID)
@pytest.mark.parametrize("resolution", [EXACT, STEP])
@pytest.mark.parametrize("seconds", [DT, 5 * DT])
def test_position_moves_no_faster_than_the_cap(side, step, resolution, seconds):
    way = side * (JOINT.velocity * seconds * (1.0 + step) + 2.0 * resolution.position)
    assert ask(guard(track(0.2)), track(0.2 + way), resolution, seconds=seconds) is (
        Protection.VELOCITY if step > 0.0 else None
    )


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("step", GRID)
@pytest.mark.parametrize("resolution", [EXACT, STEP])
@pytest.mark.parametrize("seconds", [DT, 5 * DT])
def test_velocity_changes_no_faster_than_the_acceleration_cap(side, step, resolution, seconds):
    change = side * (JOINT.acceleration * seconds * (1.0 + step) + 2.0 * resolution.velocity)
    assert ask(guard(track(velocity=0.3)), track(velocity=0.3 + change), resolution, seconds=seconds) is (
        Protection.ACCELERATION if step > 0.0 else None
    )


def stop_at(limit, side, velocity):
    """Position from which braking from a speed towards a limit ends there."""
    return limit - side * 0.5 * velocity**2 / BRAKING


@pytest.mark.parametrize(("side", "limit"), [(-1, LOWER), (1, UPPER)])
@pytest.mark.parametrize("speed", [0.0, 0.2, 0.9])
@pytest.mark.parametrize(("beyond", "refused"), [(-1e-3, False), (-1e-7, False), (3e-6, True), (1e-3, True)])
def test_a_motion_whose_stop_lies_past_a_soft_limit_is_refused(side, limit, speed, beyond, refused):
    asked = track(stop_at(limit, side, speed) + side * beyond, side * speed)
    before = asked._replace(position=asked.position - side * 1e-3)
    assert ask(guard(before), asked) is (Protection.SOFT_LIMIT if refused else None)


@pytest.mark.parametrize(("side", "limit"), [(-1, LOWER), (1, UPPER)])
@pytest.mark.parametrize("step", [-0.1, 0.1])
def test_a_stop_is_judged_within_the_resolution(side, limit, step):
    speed = 0.5
    rounding = 2.0 * (STEP.position + STEP.velocity * (speed + STEP.velocity) / BRAKING) + 1e-6
    asked = track(stop_at(limit, side, speed) + side * rounding * (1.0 + step), side * speed)
    before = track(stop_at(limit, side, speed) - side * 1e-4, side * speed)
    assert ask(guard(before), asked, STEP, seconds=1.0) is (Protection.SOFT_LIMIT if step > 0.0 else None)


@pytest.mark.parametrize(("side", "limit"), [(-1, LOWER), (1, UPPER)])
@pytest.mark.parametrize("start", [-0.01, 0.01])
def test_steps_that_rounding_would_excuse_do_not_add_up(side, limit, start):
    """Outside as well, where each may get no further than the best one so far."""
    rounding = 2.0 * (STEP.position + STEP.velocity**2 / BRAKING) + 1e-6
    joint = guard(track(limit + side * start))
    passed = 0
    for count in range(1, 1000):
        asked = track(limit + side * (start + count * STEP.position))
        if ask(joint, asked, STEP) is not None:
            break
        joint.keep(asked)
        passed = count
    assert start + passed * STEP.position == pytest.approx(max(start, 0.0) + rounding, abs=STEP.position)


@pytest.mark.parametrize("between", [Asked.of(0.0, 0.0, 0.0, 0.0, 0.0), None])
def test_after_a_pause_a_joint_outside_is_led_from_where_it_is(between):
    joint = guard(track(UPPER - 0.1))
    if between is None:
        joint.forget()
    else:
        joint.keep(between)
    outside = track(UPPER + 0.03)
    assert ask(joint, outside, position=UPPER + 0.03) is None
    joint.keep(outside)
    assert ask(joint, outside) is None


@pytest.mark.parametrize(("side", "limit"), [(-1, LOWER), (1, UPPER)])
def test_outside_a_limit_only_the_way_back_is_allowed(side, limit):
    outside = track(limit + side * 0.05)
    assert ask(guard(outside), track(limit + side * 0.049, -side * 0.01)) is None
    assert ask(guard(outside), outside) is None
    assert ask(guard(outside), track(limit + side * 0.0501)) is Protection.SOFT_LIMIT


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("step", GRID)
@pytest.mark.parametrize("resolution", [EXACT, STEP])
@pytest.mark.parametrize("last", [None, Asked.of(0.0, 0.0, 0.0, 0.0, 0.0), Asked.of(0.0, 0.0, 0.0, KD, 0.0)])
def test_the_first_message_begins_where_the_joint_is(side, step, resolution, last):
    way = side * ((SAFETY.bump + JOINT.velocity * DT) * (1.0 + step) + resolution.position)
    assert ask(guard(last), track(0.3 + way), resolution, position=0.3) is (Protection.BUMP if step > 0.0 else None)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("step", GRID)
@pytest.mark.parametrize("resolution", [EXACT, STEP])
def test_the_first_message_begins_as_the_joint_moves(side, step, resolution):
    jump = side * ((JOINT.acceleration * DT + SAFETY.velocity_tolerance) * (1.0 + step) + resolution.velocity)
    assert ask(guard(), track(velocity=0.3 + jump), resolution, velocity=0.3) is (
        Protection.BUMP if step > 0.0 else None
    )


@pytest.mark.parametrize("side", [-1, 1])
def test_a_joint_that_is_too_fast_is_led_on_at_its_cap(side):
    capped = track(velocity=side * JOINT.velocity)
    assert ask(guard(), capped, velocity=side * 3.0) is None
    assert ask(guard(), track(velocity=0.8 * capped.velocity), velocity=side * 3.0) is Protection.BUMP


@pytest.mark.parametrize("measured", [{"position": math.nan}, {"velocity": math.nan}])
def test_without_a_measurement_nothing_is_led(measured):
    assert ask(guard(), track(), **measured) is Protection.BUMP


@pytest.mark.parametrize(("side", "limit"), [(-1, LOWER), (1, UPPER)])
def test_a_start_outside_a_limit_goes_no_further_out(side, limit):
    where = limit + side * 0.03
    assert ask(guard(), track(where), position=where) is None
    assert ask(guard(), track(where + side * 1e-3), position=where) is Protection.SOFT_LIMIT
    # Moving outwards when it is taken over, it may only be braked.
    assert ask(guard(), track(where, side * 0.1), position=where, velocity=side * 0.1) is None


def test_a_drive_that_went_off_begins_anew():
    joint = guard(track(1.0))
    assert ask(joint, track(0.0)) is Protection.VELOCITY
    joint.forget()
    assert ask(joint, track(0.0)) is None


def test_a_refusal_names_the_joint_and_the_value():
    refusal = guard(track()).refuse(track(velocity=3.0), EXACT, 0.0, 0.0, DT, standing=False)
    assert refusal.text == "panda_joint2 was asked for 3.000 rad/s, above its velocity cap"


@given(st.lists(st.floats(-1.2, 1.2), min_size=1, max_size=60))
def test_whatever_is_let_through_can_be_stopped_inside_the_limits(shares):
    """Any accelerations, as shares of the cap: what the guard lets through keeps velocity, limits and stop."""
    joint, position, velocity = guard(track(UPPER - 0.02)), UPPER - 0.02, 0.0
    for share in shares:
        faster = velocity + share * JOINT.acceleration * 10 * DT
        asked = track(position + 5 * DT * (velocity + faster), faster)
        if ask(joint, asked, seconds=10 * DT) is None:
            joint.keep(asked)
            position, velocity = asked.position, asked.velocity
            assert abs(velocity) <= JOINT.velocity * 1.001
            assert LOWER <= position + 0.5 * velocity * abs(velocity) / BRAKING <= UPPER + len(shares) * 2e-6


def test_kinds():
    assert track().kind is Kind.TRACK
    assert Asked.of(0.0, 0.0, 0.0, 1.0, 0.0).kind is Kind.DAMP
    assert Asked.of(0.0, 0.0, 0.0, 0.0, 1.0).kind is Kind.TORQUE
    assert np.all(np.array(EXACT) == 0.0)


@pytest.mark.parametrize(("beyond", "refused"), [(0.9e-6, False), (1.1e-6, True)])
@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("index", [1, 3])  # the second has no 0 in the middle of its range
def test_a_stop_a_micrometre_past_a_soft_limit_is_rounding(index, side, beyond, refused):
    limits = ROBOT.profile.joints[index]
    joint = JointGuard(limits, SAFETY)
    edge = limits.position[1] if side > 0 else limits.position[0]
    inside = Asked.of(edge - side * 1e-4, 0.0, limits.gains.kp, limits.gains.kd, 0.0)
    joint.keep(inside)
    outside = inside._replace(position=edge + side * beyond)
    assert ask(joint, outside) is (Protection.SOFT_LIMIT if refused else None)


@pytest.mark.parametrize(("share", "refused"), [(0.9, False), (1.1, True)])
def test_what_rounding_may_have_cost_is_added_to_a_limit(share, refused):
    finding = ask(guard(track()), track(kd=1.001 * KD + share * STEP.kd), STEP)
    assert finding is (Protection.FRAMES if refused else None)
    most = 1.001 * JOINT.torque + share * STEP.effort
    finding = ask(guard(track(effort=JOINT.torque)), track(effort=most), STEP)
    assert finding is (Protection.TORQUE if refused else None)
