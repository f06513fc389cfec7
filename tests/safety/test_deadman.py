"""P22: the deadman's switch."""

import pytest

from robotctl.hal.robot import Robot, load_robot
from robotctl.safety.deadman import Deadman, Grip
from robotctl.safety.trip import Category, Protection

S = 1_000_000_000


def test_without_a_switch_everything_is_permitted(panda: Robot):
    deadman = Deadman(panda)
    for now in (0, 1000 * S):
        deadman.take(Grip.NONE, now)
        assert deadman.permits
        assert deadman.check(now) is None


@pytest.mark.parametrize(
    ("grip", "category", "text"),
    [
        (Grip.RELEASED, Category.BRAKE_HOLD, "is released; press it anew"),
        (Grip.UNPLUGGED, Category.BRAKE_HOLD, "is unplugged; press it anew"),
        (Grip.SQUEEZED, Category.BRAKE_OFF, "was squeezed"),
    ],
)
def test_whatever_is_not_held_stops_the_arm_at_once(panda: Robot, grip, category, text):
    deadman = Deadman(panda)
    deadman.take(Grip.HELD, 0)
    assert deadman.check(0) is None
    deadman.take(grip, 5)
    assert not deadman.permits
    trip = deadman.check(5)
    assert (trip.protection, trip.category, trip.onset_ns) == (Protection.DEADMAN, category, 5)
    assert text in trip.cause
    deadman.take(Grip.HELD, 6)
    assert deadman.permits
    assert deadman.check(6) is None


def test_a_switch_that_is_held_for_30_s_has_to_be_pressed_anew(panda: Robot):
    deadman = Deadman(panda)
    deadman.take(Grip.HELD, 7)
    deadman.take(Grip.HELD, 30 * S + 6)
    assert deadman.permits
    deadman.take(Grip.HELD, 30 * S + 7)
    assert not deadman.permits
    trip = deadman.check(30 * S + 7)
    assert trip.category is Category.BRAKE_HOLD
    assert "held for too long" in trip.cause
    deadman.take(Grip.RELEASED, 31 * S)
    assert not deadman.permits
    deadman.take(Grip.HELD, 32 * S)
    assert deadman.permits


def test_the_time_comes_from_the_profile():
    deadman = Deadman(load_robot("panda", ["safety.deadman_stuck_s=1"]))
    deadman.take(Grip.HELD, 0)
    deadman.take(Grip.HELD, S)
    assert not deadman.permits
