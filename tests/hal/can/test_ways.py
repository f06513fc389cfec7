"""In which ways a channel can be spoken on."""

from robotctl.hal.can.ways import Way, blind_spots, other_ways, own_way
from robotctl.hal.profile import CanBus

WIRING = CanBus(fd=True)


def test_a_serial_adapter_is_told_its_rate_and_so_all_are_tried():
    assert own_way("slcan:/dev/x", WIRING) == Way(1_000_000, False)
    others = other_ways("slcan:/dev/x", WIRING)
    assert others[0] == Way(1_000_000, True)
    assert {way.bitrate for way in others[1:]} == {500_000, 250_000, 125_000}


def test_a_kernel_interface_keeps_its_rate():
    assert own_way("socketcan:can0", WIRING) == Way(1_000_000, True)
    assert other_ways("socketcan:can0", WIRING) == [Way(1_000_000, False)]


def test_there_is_one_way_without_a_wire():
    assert other_ways("emulated", WIRING) == other_ways("virtual:x", WIRING) == []


def test_what_cannot_be_seen_is_said():
    assert "serial adapter" in blind_spots("slcan:/dev/x")
    assert "no wire" in blind_spots("emulated")
    assert blind_spots("socketcan:can0") == ""
