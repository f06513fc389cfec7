"""The judge counts exactly the violations that were planted."""

import numpy as np
import pytest

from robotctl.control.shared import tick_dtype
from robotctl.hal.robot import load_robot
from robotctl.safety.judge import POSITION_BOUND, REGION_BOUND, Judge
from robotctl.safety.machine import ENABLED, State
from robotctl.safety.shaper import Clip

ROBOT = load_robot("panda")
CENTRE = np.array(ROBOT.profile.sphere.centre)
RADIUS = ROBOT.profile.sphere.radius


def clean(count, state=State.RUN, has_truth=True):
    records = np.zeros(count, tick_dtype(7))
    records["state"] = state
    records["has_truth"] = has_truth
    for prefix in ("", "true_"):
        records[prefix + "position"] = ROBOT.profile.home
        records[prefix + "tool"] = CENTRE
    return records


def plant(records, index, key, excess, prefix="true_"):
    """Let one record exceed a limit by `excess`."""
    if key == "position":
        records[prefix + "position"][index, 3] = ROBOT.limits.upper[3] + excess
    elif key == "velocity":
        records[prefix + "velocity"][index, 2] = -(ROBOT.limits.velocity[2] + excess)
    else:
        records[prefix + "tool"][index] = CENTRE + np.array([0.0, RADIUS + excess, 0.0])


BOUNDS = {"position": POSITION_BOUND, "velocity": ROBOT.profile.safety.velocity_tolerance, "sphere": REGION_BOUND}


def test_the_bounds_are_half_a_milliradian_and_two_millimetres():
    assert (POSITION_BOUND, REGION_BOUND) == (0.5e-3, 2e-3)


def test_a_clean_run_has_none():
    judge = Judge(ROBOT)
    judge.take(clean(100))
    assert judge.violations == {"position": 0, "velocity": 0, "sphere": 0}
    assert judge.judged == 100
    assert all(worst < 0.0 for worst in judge.worst.values())
    assert judge.on_truth


@pytest.mark.parametrize("key", BOUNDS)
def test_each_planted_violation_is_counted_once(key):
    records = clean(50)
    for index in (0, 7, 8, 49):
        plant(records, index, key, BOUNDS[key] + 1e-6)
    for index in (20, 21):
        plant(records, index, key, BOUNDS[key] - 1e-6)
    judge = Judge(ROBOT)
    judge.take(records[:8])
    judge.take(records[8:8])
    judge.take(records[8:])
    assert judge.violations == {"position": 0, "velocity": 0, "sphere": 0} | {key: 4}
    assert judge.worst[key] == pytest.approx(BOUNDS[key] + 1e-6)


def test_keep_outs_count_where_there_are_any():
    table = "{kind: plane, name: table, point: [0, 0, 0.3], normal: [0, 0, 1], clearance: 0.01}"
    far = "{kind: plane, name: wall, point: [-9, 0, 0], normal: [1, 0, 0]}"
    judge = Judge(load_robot("panda", [f"keep_out=[{table}, {far}]"]))
    records = clean(4)
    for index, excess in ((1, REGION_BOUND + 1e-6), (2, REGION_BOUND - 1e-6)):
        records["true_tool"][index] = CENTRE * [1, 1, 0] + [0.0, 0.0, 0.31 - excess]
    judge.take(records)
    assert judge.violations == {"position": 0, "velocity": 0, "sphere": 0, "keep_out": 1}
    assert judge.worst["keep_out"] == pytest.approx(REGION_BOUND + 1e-6)


def test_lower_limits_count_like_upper_ones():
    records = clean(3)
    records["true_position"][1, 0] = ROBOT.limits.lower[0] - POSITION_BOUND - 1e-6
    judge = Judge(ROBOT)
    judge.take(records)
    assert judge.violations["position"] == 1


def test_a_tick_may_violate_everything_at_once():
    records = clean(5)
    for key in BOUNDS:
        plant(records, 2, key, 1.0)
    judge = Judge(ROBOT)
    judge.take(records)
    assert judge.violations == {"position": 1, "velocity": 1, "sphere": 1}


@pytest.mark.parametrize("state", State)
def test_ticks_count_while_the_drives_are_on(state):
    records = clean(4, state)
    for key in BOUNDS:
        plant(records, 1, key, 1.0)
    judge = Judge(ROBOT)
    judge.take(records)
    assert judge.judged == (4 if state in ENABLED else 0)
    assert set(judge.violations.values()) == {1 if state in ENABLED else 0}


def test_a_retreat_is_not_judged_but_other_clips_are():
    records = clean(3)
    for index in range(3):
        plant(records, index, "sphere", 1.0)
    records["clip"][0] = Clip.RECOVERY
    records["clip"][1] = Clip.RECOVERY | Clip.SPHERE
    records["clip"][2] = Clip.SPHERE | Clip.VELOCITY | Clip.POSITION | Clip.PREDICTED_STOP
    judge = Judge(ROBOT)
    judge.take(records)
    assert judge.violations["sphere"] == 1
    assert judge.judged == 1


def test_the_truth_counts_where_it_is_known_and_the_measurement_elsewhere():
    for has_truth in (True, False):
        records = clean(10, has_truth=has_truth)
        plant(records, 0, "velocity", 1.0, prefix="true_")
        plant(records, 1, "sphere", 1.0, prefix="")
        judge = Judge(ROBOT)
        judge.take(records)
        assert judge.violations["velocity"] == (1 if has_truth else 0)
        assert judge.violations["sphere"] == (0 if has_truth else 1)
        assert judge.on_truth is has_truth


def test_a_portion_with_some_truth_is_judged_on_what_was_measured():
    records = clean(3)
    records["has_truth"][1] = False
    plant(records, 0, "sphere", 1.0, prefix="")
    judge = Judge(ROBOT)
    judge.take(records)
    assert judge.violations["sphere"] == 1
    assert not judge.on_truth


def test_one_portion_without_truth_shows_in_the_verdict():
    judge = Judge(ROBOT)
    judge.take(clean(5))
    judge.take(clean(5, has_truth=False))
    judge.take(clean(5))
    assert not judge.on_truth
