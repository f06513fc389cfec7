"""P14 and P24: the bus and the drives."""

import numpy as np
import pytest

from robotctl.hal.robot import Robot, load_robot
from robotctl.hal.types import Fault, Sample
from robotctl.safety.drives import BusHealth, DriveHealth
from robotctl.safety.trip import Category, Protection

STAMP = 7_000_000
HOT = 90.0


def sample(dof=7, **fields):
    rest = np.zeros(dof)
    return Sample(STAMP, rest, rest, rest, np.full(dof, STAMP), **({"enabled": True} | fields))


def warm(joint, degrees, dof=7):
    temperature = np.full(dof, 30.0)
    temperature[joint] = degrees
    return sample(dof, temperature=temperature)


BUS_OFF = Fault("bus", 0x40, "BUS_OFF", "check cable and termination")
UNDERVOLTAGE = Fault("joint4", 0x9, "UNDER_VOLTAGE", "check the supply")


def test_a_bus_in_trouble_stops_the_arm(panda: Robot):
    assert BusHealth().check(sample()) is None
    trip = BusHealth().check(sample(faults=(UNDERVOLTAGE, BUS_OFF)))
    assert (trip.protection, trip.category, trip.onset_ns) == (Protection.BUS, Category.BRAKE_OFF, STAMP)
    assert trip.cause == "the bus reports BUS_OFF; check cable and termination, then acknowledge"
    assert BusHealth().check(sample(faults=(UNDERVOLTAGE,))) is None


def test_five_commands_in_a_row_that_do_not_leave_stop_the_arm():
    bus = BusHealth()
    for delivered in (False, False, False, False, True, False, False, False, False):
        bus.sent(delivered=delivered)
        assert bus.check(sample()) is None
    bus.sent(delivered=False)
    trip = bus.check(sample())
    assert (trip.protection, trip.category, trip.onset_ns) == (Protection.BUS, Category.BRAKE_OFF, STAMP)
    assert "5 commands in a row" in trip.cause


def test_what_did_not_leave_before_the_drives_went_off_is_forgotten():
    bus = BusHealth()
    for _ in range(5):
        bus.sent(delivered=False)
    bus.forget()
    assert bus.check(sample()) is None
    for _ in range(4):
        bus.sent(delivered=False)
    assert bus.check(sample()) is None


def test_a_drives_fault_stops_the_arm_and_is_named(panda: Robot):
    check = DriveHealth(panda)
    assert check.check(sample()) is None
    trip = check.check(sample(faults=(BUS_OFF, UNDERVOLTAGE), enabled=False))
    assert (trip.protection, trip.category, trip.onset_ns) == (Protection.DRIVE, Category.BRAKE_OFF, STAMP)
    assert trip.cause == "joint4: drive reports UNDER_VOLTAGE (code 0x9); check the supply"
    assert check.check(sample(faults=(BUS_OFF,))) is None


def test_a_drive_that_went_off_stops_the_arm(panda: Robot):
    trip = DriveHealth(panda).check(sample(enabled=False))
    assert (trip.protection, trip.category) == (Protection.DRIVE, Category.BRAKE_OFF)
    assert "went off by itself" in trip.cause


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize(("above", "warns", "trips"), [
    (-11.0, False, False), (-10.0, False, False), (-9.0, True, False), (0.0, True, False), (1.0, True, True),
])  # fmt: skip
def test_a_hot_drive_is_warned_of_and_then_stops_the_arm(panda: Robot, joint, above, warns, trips):
    check, name = DriveHealth(panda), panda.profile.joints[joint].name
    trip, warning = check.check(warm(joint, HOT + above)), check.warning(warm(joint, HOT + above))
    assert warning == (f"{name} is at {HOT + above:.0f} degrees C" if warns else "")
    assert (trip is not None) is trips
    if trip is not None:
        assert (trip.protection, trip.category, trip.onset_ns) == (Protection.DRIVE, Category.BRAKE_OFF, STAMP)
        assert name in trip.cause


def test_drives_that_tell_no_temperature_are_not_judged_by_it(panda: Robot):
    assert DriveHealth(panda).check(sample()) is None
    assert DriveHealth(panda).warning(sample()) == ""


def test_the_temperature_limit_comes_from_the_profile():
    check = DriveHealth(load_robot("panda", ["safety.temperature=50"]))
    assert check.check(warm(0, 51.0)) is not None
    assert check.warning(warm(0, 41.0)) != ""
