"""The bench of a bus measures what it says it does."""

import pytest

from robotctl.hal.can.channel import open_channel
from robotctl.hal.can.damiao.benchmark import EDGES_US, STAGES, bench_bus
from robotctl.hal.clock import VirtualClock
from robotctl.hal.errors import ConfigError, DriveError
from robotctl.hal.robot import load_robot
from robotctl.sim.motors.trouble import Mute

OPENARM = load_robot("openarm")


@pytest.fixture
def clock():
    return VirtualClock(1_000_000_000)


@pytest.fixture
def channel(clock):
    opened = open_channel("emulated", OPENARM, clock)
    yield opened
    opened.close()


def test_all_eight_drives_answer_every_cycle_of_either_kind(channel, clock):
    report = bench_bus(OPENARM, clock, channel, 100)
    assert report["motors"] == 8
    assert report["missed"] == {"bare": 0, "ours": 0}
    assert report["wire_us"] == pytest.approx(1040, rel=0.01)
    assert report["ratio"] == pytest.approx(report["cycle_us"]["p50"] / report["bare_us"]["p50"], abs=0.02)


def test_the_histogram_holds_every_cycle_once_per_stage(channel, clock):
    report = bench_bus(OPENARM, clock, channel, 100)
    assert list(report["histogram"]["counts"]) == list(STAGES)
    for counts in report["histogram"]["counts"].values():
        assert len(counts) == len(EDGES_US) + 1
        assert sum(counts) == 100
    stages = report["stages_us"]
    assert 0.0 < stages["first reply"]["p50"] < stages["last reply"]["p50"]


def test_nothing_is_enabled_and_nothing_moves(channel, clock):
    before = channel.truth().position
    bench_bus(OPENARM, clock, channel, 100)
    assert not any(drive.enabled for drive in channel.bus.bench.drives)
    assert channel.truth().position == pytest.approx(before, abs=1e-3)


def test_a_drive_that_is_on_is_left_alone(channel, clock):
    channel.bus.bench.drive(3).on_mit(b"\xff" * 7 + b"\xfc", clock.now_ns())
    with pytest.raises(ConfigError, match="motor 3 is enabled"):
        bench_bus(OPENARM, clock, channel, 100)


def test_a_drive_that_is_silent_is_named(channel, clock):
    channel.bus.bench.trouble.add(Mute(motor_id=5))
    with pytest.raises(DriveError, match="motor 5"):
        bench_bus(OPENARM, clock, channel, 100)


def test_replies_that_get_lost_are_counted(channel, clock):
    channel.bus.bench.trouble.add(Mute(motor_id=5, from_ns=clock.now_ns() + 2_000_000_000))
    report = bench_bus(OPENARM, clock, channel, 200)
    assert report["missed"]["bare"] > 0
    assert report["missed"]["ours"] > 0
