"""Dumps: readable, exact, and never overwritten; and the count of writes to flash."""

import json
import struct

import pytest

from robotctl.hal.can.dump import Dump, DumpedMotor, read_dump, readable, write_dump
from robotctl.hal.can.flash_log import count_writes, writes
from robotctl.hal.errors import ConfigError

MOTOR = DumpedMotor(id=3, name="joint3", protocol="damiao", serial=77, parameters={"PMAX": 12.5, "SN": 77.0})
DUMP = Dump(taken="2026-11-25T10:00:00+01:00", host="bench", version="0", robot="openarm", channel="x", motors=[MOTOR])


def test_what_is_written_is_read(tmp_path):
    write_dump(tmp_path / "d.yaml", DUMP)
    assert read_dump(tmp_path / "d.yaml") == DUMP
    assert "PMAX: 12.5\n" in (tmp_path / "d.yaml").read_text()
    with pytest.raises(ConfigError, match="already exists"):
        write_dump(tmp_path / "d.yaml", DUMP)


@pytest.mark.parametrize("value", [0.004, 1e-20, 3e9, -0.1, 0.945, 1 / 3])
def test_numbers_are_short_and_lose_nothing(value):
    stored = struct.unpack("<f", struct.pack("<f", value))[0]
    assert struct.pack("<f", readable(stored)) == struct.pack("<f", stored)
    assert len(repr(readable(stored))) <= 15


def test_a_broken_file_is_named_with_its_line(tmp_path):
    path = tmp_path / "d.yaml"
    write_dump(path, DUMP)
    path.write_text(path.read_text().replace("PMAX: 12.5", "PMAX: much"))
    with pytest.raises(ConfigError, match=r"d\.yaml:\d+: motors\.0\.parameters\.PMAX"):
        read_dump(path)


def test_drives_are_found_by_id_and_by_serial_number():
    assert DUMP.motor(3) is MOTOR
    assert DUMP.owner(77) is MOTOR
    assert DUMP.owner(78) is None
    with pytest.raises(ConfigError, match="no drive 0x04"):
        DUMP.motor(4)


def test_writes_are_counted_per_drive(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert writes("damiao", 77) == 0
    assert [count_writes("damiao", 77, times) for times in (1, 2)] == [1, 3]
    assert count_writes("damiao", 78) == 1
    assert writes("damiao", 77) == 3
    assert json.loads((tmp_path / "robotctl" / "flash.json").read_text()) == {
        "damiao:0x0000004D": 3,
        "damiao:0x0000004E": 1,
    }
    (tmp_path / "robotctl" / "flash.json").write_text("[]")
    with pytest.raises(ConfigError, match="cannot be read"):
        writes("damiao", 77)
