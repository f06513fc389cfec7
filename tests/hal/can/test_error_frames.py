"""Error frames of SocketCAN, told apart by what causes them. Values: linux/can/error.h."""

import pytest

from robotctl.hal.can.error_frames import ErrorKind, ErrorLog


@pytest.mark.parametrize(
    ("error_class", "data", "kind"),
    [
        (0x020, bytes(8), ErrorKind.NO_ACK),
        (0x008, bytes([0, 0, 0, 0x19, 0, 0, 0, 0]), ErrorKind.NO_ACK),
        (0x088, bytes([0, 0, 0x04, 0, 0, 0, 0, 0]), ErrorKind.GARBLED),
        (0x080, bytes(8), ErrorKind.GARBLED),
        (0x004, bytes([0, 0x10, 0, 0, 0, 0, 0, 0]), ErrorKind.CONTROLLER),
        (0x040, bytes(8), ErrorKind.BUS_OFF),
        (0x002, bytes(8), None),
    ],
)
def test_kinds(error_class, data, kind):
    log = ErrorLog()
    log.take(error_class, data)
    assert dict(log.kinds) == ({kind: 1} if kind else {})


def test_states_and_counters():
    log = ErrorLog()
    assert (log.state, log.counters) == ("active", None)
    log.take(0x204, bytes([0, 0x20, 0, 0, 0, 0, 136, 7]))
    assert (log.state, log.counters) == ("passive", (136, 7))
    log.take(0x004, bytes([0, 0x40, 0, 0, 0, 0, 9, 9]))
    assert (log.state, log.counters) == ("active", (136, 7))
    log.take(0x040, bytes(8))
    log.take(0x004, bytes([0, 0x40, 0, 0, 0, 0, 0, 0]))
    assert log.state == "bus-off"
    log.take(0x100, bytes(8))
    assert log.state == "active"
