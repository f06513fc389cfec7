"""Golden vectors: bytes worked out by hand from CiA 301 and from the layout of our PDOs, little-endian."""

import struct

import pytest

from robotctl.hal.can.cia402 import codec
from robotctl.hal.can.cia402.codec import (
    Emergency,
    FeedForward,
    Mode,
    Motion,
    Nmt,
    NmtCommand,
    Service,
    Setpoint,
    Status,
)

GOLDEN = [
    ("setpoint", Setpoint(0x0F, Mode.POSITION, 0x12345678), "0f 00 08 78 56 34 12"),
    ("setpoint", Setpoint(0x06, Mode.TORQUE, -1), "06 00 0a ff ff ff ff"),
    ("setpoint", Setpoint(0x80, -1, -0x80000000), "80 00 ff 00 00 00 80"),
    ("feed_forward", FeedForward(-2, 1000), "fe ff ff ff e8 03"),
    ("feed_forward", FeedForward(131072, -1), "00 00 02 00 ff ff"),
    ("status", Status(0x1237, -131072, -250), "37 12 00 00 fe ff 06 ff"),
    ("status", Status(0x0250, 1, 0), "50 02 01 00 00 00 00 00"),
    ("motion", Motion(-100, Mode.VELOCITY), "9c ff ff ff 09"),
    ("emergency", Emergency(0x8130, 0x11, bytes(5)), "30 81 11 00 00 00 00 00"),
    ("emergency", Emergency(0, 0, b"abcde"), "00 00 00 61 62 63 64 65"),
]


@pytest.mark.parametrize(("kind", "value", "text"), GOLDEN)
def test_frames_have_these_bytes(kind: str, value: tuple, text: str):
    data = bytes.fromhex(text)
    assert getattr(codec, f"encode_{kind}")(value) == data
    assert getattr(codec, f"decode_{kind}")(data) == value


def test_heartbeat_and_network_management():
    assert codec.encode_heartbeat(Nmt.OPERATIONAL) == b"\x05"
    assert codec.encode_nmt(NmtCommand.ENTER_PRE_OPERATIONAL, 3) == b"\x80\x03"


def test_ids_are_those_of_the_predefined_connection_set():
    ids = {service: service + 5 for service in Service}
    assert ids == {
        Service.EMCY: 0x085, Service.TPDO1: 0x185, Service.RPDO1: 0x205, Service.TPDO2: 0x285, Service.RPDO2: 0x305,
        Service.SDO_REPLY: 0x585, Service.SDO: 0x605, Service.HEARTBEAT: 0x705,
    }  # fmt: skip


@pytest.mark.parametrize("value", [Setpoint(0, 0, 1 << 31), Setpoint(0x10000, 0, 0), Setpoint(0, 200, 0)])
def test_what_does_not_fit_is_refused(value: Setpoint):
    with pytest.raises(struct.error):
        codec.encode_setpoint(value)
