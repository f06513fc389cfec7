"""Servo rates and what buses carry."""

import pytest

from robotctl.hal.backend import open_backend
from robotctl.hal.can.bandwidth import cycle_s, frame_time_ns, highest_hz, require_bandwidth
from robotctl.hal.can.channel import Channel
from robotctl.hal.clock import VirtualClock
from robotctl.hal.errors import ConfigError
from robotctl.hal.profile import CanBus
from robotctl.hal.robot import load_robot

WIRING = CanBus()
OPENARM = load_robot("openarm")
DRIVE = OPENARM.profile.drives[0]


def test_a_cycle_of_eight_drives_is_one_millisecond_on_fd_and_two_on_classic():
    assert cycle_s([DRIVE] * 8, WIRING, fd=True) == pytest.approx(1.04e-3, rel=0.01)
    assert cycle_s([DRIVE] * 8, WIRING, fd=False) == pytest.approx(2.16e-3, rel=0.01)


@pytest.mark.parametrize(
    ("drives", "fd", "hz"), [(8, True, 500), (8, False, 250), (7, False, 250), (16, False, 200), (12, True, 500)]
)
def test_what_fits_passes(drives, fd, hz):
    require_bandwidth("socketcan:can0", [DRIVE] * drives, hz, WIRING, fd)


@pytest.mark.parametrize(
    ("drives", "fd", "hz", "why"),
    [
        (8, False, 500, r"(?s)8 drives at 500 Hz do not fit on classic CAN at 1 Mbit/s.*2.16 ms.*108%.*servo_hz=250"),
        (8, False, 251, r"servo_hz=250, or CAN FD, or a second bus"),
        (16, False, 250, r"servo_hz=208"),
        (16, True, 500, r"(?s)on CAN FD at 1/5 Mbit/s.*servo_hz=432, or a second bus"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_highest_rate(drives, fd, hz, why):
    with pytest.raises(ConfigError, match=why):
        require_bandwidth("socketcan:can0", [DRIVE] * drives, hz, WIRING, fd)


def test_cia_402_drives_take_and_give_two_frames_each_and_share_one_sync():
    seven = load_robot("xarm7").profile.drives
    assert cycle_s(seven, WIRING, fd=False) == pytest.approx(3.415e-3)
    assert cycle_s([*seven, DRIVE], WIRING, fd=False) == pytest.approx(3.415e-3 + 0.27e-3)


def test_a_slow_bus_carries_less():
    assert highest_hz([DRIVE] * 8, CanBus(bitrate=500_000), fd=False) == 208


def test_an_arm_that_finds_itself_on_classic_can_is_refused_before_a_frame_is_sent():
    arm = open_backend("can", OPENARM, VirtualClock()).arm
    channel = open_backend("can", OPENARM, VirtualClock()).arm
    channel.connect()
    bus = channel.channel.bus
    with pytest.raises(ConfigError, match="do not fit on classic CAN"):
        arm.connect_to(Channel(bus, fd=False, simulated=True))
    assert arm.channel is None
    assert not bus.bench.replies
    channel.close()


def test_at_half_the_rate_classic_can_will_do():
    slow = load_robot("openarm", ["servo_hz=250", "can.fd=false"])
    arm = open_backend("can", slow, VirtualClock(1_000_000_000)).arm
    arm.connect()
    arm.verify()
    arm.close()


def test_frame_times():
    assert frame_time_ns(False, 1_000_000, 0) == pytest.approx(135e3)
    assert frame_time_ns(True, 1_000_000, 5_000_000) == pytest.approx(65e3)
