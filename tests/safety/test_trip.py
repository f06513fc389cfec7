"""What each protection takes to be cleared."""

import pytest

from robotctl.safety.trip import Category, Clearing, Protection

BY_START = {Protection.MALFORMED, Protection.HEARTBEAT}
BY_POWER = {
    Protection.VELOCITY,
    Protection.SOFT_LIMIT,
    Protection.ACCELERATION,
    Protection.TORQUE,
    Protection.FRAMES,
    Protection.DRIVE,
}


@pytest.mark.parametrize("protection", Protection)
def test_clearing(protection: Protection) -> None:
    expected = Clearing.START if protection in BY_START else Clearing.POWER if protection in BY_POWER else Clearing.ACK
    assert protection.clearing is expected


def test_a_label_is_the_number_in_the_table_of_protections() -> None:
    assert Protection.POSITION.label == "P3"
    assert Protection.RESET.label == "P29"


def test_a_harder_stop_has_a_smaller_number() -> None:
    assert Category.CUT < Category.BRAKE_OFF < Category.BRAKE_HOLD
