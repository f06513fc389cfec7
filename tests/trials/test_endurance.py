"""A long run on a bad bus, cut short."""

from random import Random

import pytest

from robotctl.hal.robot import load_robot
from robotctl.sim.motors.trouble import Mute, Reply
from robotctl.trials import endurance
from robotctl.trials.endurance import BadBus, drifts, endure

OPENARM = load_robot("openarm")
REPLY = Reply(0x11, bytes(8), True, 1_000_000)


def test_frames_that_are_lost_late_or_doubled_stop_nothing():
    result = endure(OPENARM, 1500, share=0.01, seed=3)
    assert result["ticks"] >= 1500
    assert result["stops"] == []
    assert not any(result["violations"].values())
    assert result["frames"]["missed_replies"] > 50


def test_what_does_stop_the_arm_is_told(monkeypatch):
    monkeypatch.setattr(endurance, "BadBus", lambda share, dice: Mute(motor_id=2))
    result = endure(OPENARM, 1500)
    assert result["ticks"] < 200
    assert "P12: openarm_right_joint2 has not answered" in result["stops"][0]


def test_a_share_of_the_frames_goes_wrong_and_replies_in_each_of_three_ways():
    bus = BadBus(share=0.3, dice=Random(1))
    assert sum(not bus.hears(Random()) for _ in range(9000)) == pytest.approx(2700, rel=0.1)
    fates = [bus.alter([REPLY], Random()) for _ in range(9000)]
    lost = sum(not fate for fate in fates)
    doubled = sum(len(fate) == 2 for fate in fates)
    late = [fate[0].stamp_ns - REPLY.stamp_ns for fate in fates if len(fate) == 1 and fate[0] != REPLY]
    assert [lost, doubled, len(late)] == pytest.approx([900, 900, 900], rel=0.15)
    assert 0 <= min(late) <= max(late) < 5_000_000


@pytest.mark.parametrize(("megabytes", "descriptors", "found"), [(3.0, 0, False), (11.0, 0, True), (0.0, 1, True)])
def test_what_grows_is_found(megabytes, descriptors, found):
    assert drifts({"rss_growth_mb": megabytes, "descriptor_growth": descriptors}) is found


def test_memory_and_descriptors_are_looked_at_as_it_runs(monkeypatch):
    monkeypatch.setattr(endurance, "WARM_UP", 100)
    monkeypatch.setattr(endurance, "_LOOK_EVERY", 100)
    seen = []
    result = endure(OPENARM, 400, on_look=seen.append)
    assert result["looks"] == seen
    assert len(seen) >= 3
    assert all(look["rss_mb"] > 50.0 and look["descriptors"] > 2 for look in seen)
