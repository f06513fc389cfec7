"""P9 and P10: what a policy may say, and for how long it counts."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from robotctl.hal.robot import Robot, load_robot
from robotctl.safety.admission import Admission
from robotctl.safety.target import FreeDrive, Hold, JointTorque, JointVelocity
from robotctl.safety.trip import Category, Protection

ROBOT = load_robot("panda")
MS = 1_000_000


@pytest.fixture
def admission() -> Admission:
    return Admission(ROBOT)


def velocity(values: object = None, epoch: int = 0, seq: int = 0, deadline_ms: float = 100) -> JointVelocity:
    array = np.zeros(7) if values is None else values
    return JointVelocity(array, epoch, seq, round(deadline_ms * MS))  # type: ignore[arg-type]


@given(hnp.arrays(np.float64, 7, elements=st.floats(width=64)))
def test_nothing_but_finite_values_is_admitted(values: np.ndarray) -> None:
    admission = Admission(ROBOT)
    trip = admission.offer(velocity(values), 0, 0)
    assert (trip is None) == bool(np.isfinite(values).all())
    assert (admission.fresh(0) is not None) == bool(np.isfinite(values).all())


@pytest.mark.parametrize("index", range(7))
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("kind", [JointVelocity, JointTorque])
def test_one_bad_value_drops_the_whole_target(admission: Admission, index: int, bad: float, kind: type) -> None:
    values = np.zeros(7)
    values[index] = bad
    trip = admission.offer(kind(values, 0, 0, 100 * MS), 0, 0)
    assert trip is not None
    assert trip.protection is Protection.MALFORMED
    assert trip.category is Category.BRAKE_HOLD
    assert f"value {index}" in trip.cause
    assert admission.fresh(0) is None


@pytest.mark.parametrize(
    "values",
    [
        np.zeros(6),
        np.zeros(8),
        np.zeros((7, 1)),
        np.zeros(0),
        np.zeros(7, np.int64),
        np.zeros(7, np.float32),
        [0.0] * 7,
    ],
)
def test_wrong_shape_or_type_is_malformed(admission: Admission, values: object) -> None:
    assert admission.offer(velocity(values), 0, 0) is not None


def test_what_is_no_target_at_all_is_malformed(admission: Admission) -> None:
    trip = admission.offer("go left", 0, 0)  # type: ignore[arg-type]
    assert trip is not None
    assert "str" in trip.cause


def test_negative_zero_and_huge_values_are_let_in_for_the_shaper(admission: Admission) -> None:
    assert admission.offer(velocity(np.full(7, -0.0)), 0, 0) is None
    assert admission.offer(velocity(np.full(7, 1e300), seq=1), 0, 0) is None


def test_three_malformed_targets_in_a_second_are_a_fault(admission: Admission) -> None:
    bad = np.full(7, np.nan)
    categories = [admission.offer(velocity(bad), 0, at * MS).category for at in (0, 50, 100)]  # type: ignore[union-attr]
    assert categories == [Category.BRAKE_HOLD, Category.BRAKE_HOLD, Category.BRAKE_OFF]


@pytest.mark.parametrize(
    ("third_ns", "category"),
    [(1000 * MS, Category.BRAKE_OFF), (1000 * MS + 1, Category.BRAKE_HOLD)],
)
def test_the_second_counts_from_the_first_of_three(admission: Admission, third_ns: int, category: Category) -> None:
    began = 5000 * MS
    trips = [admission.offer(velocity(np.zeros(6)), 0, began + at) for at in (0, 500 * MS, third_ns)]
    assert trips[-1].category is category  # type: ignore[union-attr]
    assert ("3 times within 1 s" in trips[-1].cause) is (category is Category.BRAKE_OFF)  # type: ignore[union-attr]
    assert "times within" not in trips[0].cause  # type: ignore[union-attr]


def test_malformed_targets_far_apart_are_not(admission: Admission) -> None:
    bad = np.full(7, np.nan)
    categories = [admission.offer(velocity(bad), 0, at * MS).category for at in (0, 600, 1200)]  # type: ignore[union-attr]
    assert Category.BRAKE_OFF not in categories


@pytest.mark.parametrize("epoch", [0, 2])
def test_another_epoch_is_dropped(admission: Admission, epoch: int) -> None:
    assert admission.offer(velocity(epoch=epoch), 1, 0) is None
    assert admission.fresh(0) is None
    assert admission.refused == 1


def test_old_sequence_numbers_are_dropped(admission: Admission) -> None:
    assert admission.offer(velocity(np.ones(7), seq=5), 0, 0) is None
    for seq in (5, 4, 0):
        admission.offer(velocity(np.zeros(7), seq=seq), 0, 0)
    assert admission.refused == 3
    assert admission.fresh(0).values[0] == 1.0  # type: ignore[union-attr]


@pytest.mark.parametrize(("now_ms", "fresh"), [(0, True), (99, True), (100, False), (150, False)])
def test_a_target_expires_with_its_heartbeat(admission: Admission, now_ms: int, fresh: bool) -> None:
    admission.offer(velocity(deadline_ms=10_000), 0, 0)
    assert (admission.fresh(now_ms * MS) is not None) is fresh
    assert (admission.heartbeat(now_ms * MS) is None) is fresh


def test_an_earlier_deadline_of_its_own_counts(admission: Admission) -> None:
    admission.offer(velocity(deadline_ms=30), 0, 0)
    assert admission.fresh(29 * MS) is not None
    assert admission.fresh(30 * MS) is None


def test_a_target_that_is_late_on_arrival_is_dropped(admission: Admission) -> None:
    admission.offer(velocity(deadline_ms=30), 0, 30 * MS)
    assert admission.refused == 1


def test_the_heartbeat_names_its_onset(admission: Admission) -> None:
    admission.renew(0)
    trip = admission.heartbeat(102 * MS)
    assert trip is not None
    assert trip.onset_ns == 100 * MS
    assert trip.category is Category.BRAKE_HOLD


def test_a_new_policy_begins_with_any_sequence_number(admission: Admission) -> None:
    admission.offer(velocity(seq=50), 0, 0)
    admission.begin(5 * MS)
    assert admission.fresh(5 * MS) is None
    assert admission.heartbeat(105 * MS - 1) is None
    assert admission.heartbeat(105 * MS) is not None
    admission.offer(velocity(seq=-1), 0, 5 * MS)
    assert admission.refused == 1
    admission.offer(velocity(seq=0), 0, 5 * MS)
    assert admission.seq == 0


def test_the_first_sequence_number_is_0(admission: Admission) -> None:
    admission.offer(velocity(seq=-1), 0, 0)
    assert admission.refused == 1
    admission.offer(velocity(seq=0), 0, 0)
    assert admission.refused == 1


def test_before_the_first_target_there_is_none_and_none_is_awaited(admission: Admission) -> None:
    assert admission.fresh(-1) is None
    assert admission.heartbeat(-1) is None
    trip = admission.heartbeat(0)
    assert trip is not None
    assert "for 100 ms" in trip.cause


@pytest.mark.parametrize("kind", [Hold, FreeDrive])
def test_targets_without_values_keep_the_heartbeat(admission: Admission, kind: type) -> None:
    assert admission.offer(kind(0, 0, 100 * MS), 0, 0) is None
    assert admission.heartbeat(99 * MS) is None


def test_shape_follows_the_robot() -> None:
    kinova: Robot = load_robot("kinova")
    assert Admission(kinova).offer(velocity(np.zeros(7)), 0, 0) is not None
    assert Admission(kinova).offer(velocity(np.zeros(6)), 0, 0) is None
