"""What `doctor` says of a profile and of the drives that a scan found."""

import pytest

from robotctl.hal.can.channel import Channel
from robotctl.hal.can.damiao.registers import Register
from robotctl.hal.can.diagnosis import drive_findings, profile_findings
from robotctl.hal.can.scan import scan
from robotctl.hal.clock import VirtualClock
from robotctl.hal.errors import ConfigError
from robotctl.hal.host import Level
from robotctl.hal.robot import load_robot


def findings(bench):
    return drive_findings(bench.robot, scan(Channel(bench.bus, fd=True, simulated=True), VirtualClock()).motors)


def test_healthy_drives_are_fine(bench):
    found = findings(bench)
    assert len(found) == 8
    assert all(finding.level is Level.OK for finding in found)


@pytest.mark.parametrize(
    ("change", "level", "word"),
    [
        (lambda m: setattr(m, "mute", True), Level.FAIL, "does not answer"),
        (lambda m: setattr(m, "reply_id", 0x44), Level.FAIL, "answers on 0x44"),
        (lambda m: setattr(m, "status", 0xE), Level.FAIL, "OVERLOAD"),
        (lambda m: m.registers.update({Register.TIMEOUT: 0}), Level.FAIL, "no watchdog"),
        (lambda m: m.registers.update({Register.TIMEOUT: 8000}), Level.FAIL, "400 ms"),
        (lambda m: m.registers.update({Register.TIMEOUT: 1199}), Level.WARN, "before the watchman"),
        (lambda m: m.registers.update({Register.VMAX: 8.0}), Level.FAIL, "ranges"),
        (lambda m: m.registers.update({Register.CTRL_MODE: 2}), Level.WARN, "control mode 2"),
        (lambda m: m.registers.update({Register.CAN_BR: 4}), Level.FAIL, "classic CAN"),
        (lambda m: m.registers.update({Register.VBUS: 11.0}), Level.FAIL, "supply is 11.0 V, it needs 15.0"),
        (lambda m: m.registers.update({Register.SW_VER: 5012}), Level.WARN, "5012 on 0x05, 5013 on 0x06 0x07"),
        (lambda m: setattr(m, "position", 3.1), Level.FAIL, "its zero is wrong"),
        (lambda m: setattr(m, "temperature", 85), Level.WARN, "85 °C"),
        (lambda m: setattr(m, "temperature", 95), Level.FAIL, "95 °C; the arm is stopped at 90"),
    ],
)
def test_every_deviation_is_named(bench, change, level, word):
    change(bench.motors[4])
    bad = [finding for finding in findings(bench) if finding.level is not Level.OK]
    assert [finding.level for finding in bad] == [level]
    assert word in bad[0].text
    assert "0x05" in bad[0].name + bad[0].text
    assert bad[0].remedy


def test_shared_ids_and_strangers(bench, scripted_motor):
    bench.bus.motors += [
        scripted_motor(5, 0x15, bench.motors[4].ranges),
        scripted_motor(20, 0x30, bench.motors[4].ranges),
    ]
    bad = [finding for finding in findings(bench) if finding.level is not Level.OK]
    assert "2 motors share this id" in bad[0].text
    assert bad[-1].level is Level.WARN
    assert bad[-1].name == "0x14"


def test_classic_can_at_500_hz_is_refused_and_at_250_hz_is_half_a_load():
    with pytest.raises(ConfigError, match="classic CAN carries at most 250 Hz"):
        load_robot("panda", ["can.fd=false"])
    robot = load_robot("panda", ["can.fd=false", "servo_hz=250"])
    load = next(finding for finding in profile_findings(robot) if finding.name == "bus load")
    assert load.level is not Level.FAIL
    assert "54 %" in load.text


def test_a_profile_without_drives_is_only_a_warning():
    found = profile_findings(load_robot("kinova"))
    assert Level.FAIL not in [finding.level for finding in found]
    assert any("simulation only" in finding.text for finding in found)


def test_a_sphere_gain_too_high_for_the_lag():
    robot = load_robot("panda", ["twin.lag_s=0.1"])
    assert any(finding.name == "sphere_gain" and "2.50" in finding.remedy for finding in profile_findings(robot))


@pytest.mark.parametrize(("patience", "level"), [("0.08", Level.OK), ("0.081", Level.WARN)])
def test_a_watchman_that_comes_after_the_drives_own_watchdogs_is_warned_of(patience, level):
    robot = load_robot("openarm", [f"safety.watchman_s={patience}"])
    (finding,) = [finding for finding in profile_findings(robot) if finding.name == "watchman"]
    assert finding.level is level
    assert bool(finding.remedy) is (level is Level.WARN)
