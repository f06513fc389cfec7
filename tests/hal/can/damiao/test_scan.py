"""Scanning finds who is there, changes nothing, and says what to try when nobody is."""

import pytest

from robotctl.hal.can.channel import Channel
from robotctl.hal.can.damiao.codec import BROADCAST_ID
from robotctl.hal.can.damiao.motors import MOTORS
from robotctl.hal.can.damiao.probe import guess_models
from robotctl.hal.can.damiao.registers import Register
from robotctl.hal.can.scan import scan
from robotctl.hal.can.verdict import bus_findings
from robotctl.hal.clock import VirtualClock
from robotctl.hal.host import Level


@pytest.fixture
def look(scripted_bus):
    def look(motors, **options):
        bus = scripted_bus(motors)
        found = scan(Channel(bus, fd=True, simulated=True), VirtualClock(), **options)
        bus.shutdown()
        return found, bus

    return look


def test_scan_only_reads(look, scripted_motor):
    motors = [scripted_motor(3, 0x13, MOTORS["DM4310"]), scripted_motor(9, 0, MOTORS["DM8009"])]
    found, bus = look(motors)
    assert [motor.id for motor in found.motors] == [3, 9]
    assert {m.arbitration_id for m in bus.sent} == {BROADCAST_ID}
    assert {m.data[2] for m in bus.sent} == {0x33, 0xCC}
    assert not any(m.is_fd for m in bus.sent)
    assert all(motor.status == 0 and not motor.written for motor in motors)
    assert {finding.level for finding in bus_findings([found], "")} == {Level.OK}


def test_scan_tells_all_it_learned(look, scripted_motor):
    found, _ = look([scripted_motor(3, 0x13, MOTORS["DM4310"], position=1.0)])
    (motor,) = found.motors
    assert motor.reply_ids == (0x13,)
    assert motor.identity.software == 5013
    assert motor.identity.mode == 1
    assert motor.identity.timeout_s == pytest.approx(0.1)
    assert motor.models == ("DM4310",)
    assert motor.bitrate == 5_000_000
    assert motor.position == pytest.approx(1.0, abs=1e-3)
    assert (motor.mosfet_temperature, motor.rotor_temperature) == (31, 28)
    assert motor.status == "DISABLED"


def test_one_lost_reply_hides_nobody(look, scripted_motor):
    motor = scripted_motor(3, 0x13, MOTORS["DM4310"])
    motor.drop_next = 2
    assert len(look([motor])[0].motors) == 1


@pytest.mark.parametrize("replies", [(0x13, 0x13), (0x13, 0x23)])
def test_two_motors_with_one_id(look, scripted_motor, replies):
    found, _ = look([scripted_motor(3, reply, MOTORS["DM4310"]) for reply in replies])
    (finding,) = bus_findings([found], "")
    assert (finding.name, finding.level) == ("0x03", Level.FAIL)
    assert "2 motors share this id" in finding.text


def test_a_missing_watchdog_is_hinted_at(look, scripted_motor):
    motor = scripted_motor(3, 0x13, MOTORS["DM4310"])
    motor.registers[Register.TIMEOUT] = 0
    (finding,) = bus_findings([look([motor])[0]], "")
    assert "watchdog is off" in finding.text


def test_a_motor_with_strange_ranges_has_no_model():
    assert guess_models(MOTORS["DM4310"]._replace(vmax=31.0)) == ()
    assert guess_models(MOTORS["DMH6215"]) == ("DMH6215", "DMG6220")
