import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotctl.hal.can.damiao.registers import (
    CAN_BITRATES,
    REGISTERS,
    TIMEOUT_UNIT_S,
    ControlMode,
    Register,
    decode_value,
    encode_value,
)

INTEGERS = {7, 8, 9, 10, 13, 14, 15, 16, 35, 36}


def test_types_are_the_vendors() -> None:
    assert {number for number, info in REGISTERS.items() if info.integer} == INTEGERS
    assert set(REGISTERS) == {*range(37), *range(50, 57), *range(59, 66), 80, 81}


def test_what_identifies_a_drive_cannot_be_written() -> None:
    for register in (Register.HW_VER, Register.SW_VER, Register.SN, Register.SUB_VER, Register.P_M, Register.XOUT):
        assert not REGISTERS[register].writable
    for register in (Register.MST_ID, Register.ESC_ID, Register.TIMEOUT, Register.CTRL_MODE, Register.CAN_BR):
        assert REGISTERS[register].writable


def test_every_named_register_is_in_the_map() -> None:
    for register in Register:
        assert REGISTERS[register].name.upper() == register.name


@pytest.mark.parametrize(
    ("register", "value", "raw"),
    [
        (Register.TIMEOUT, 8000, "401F0000"),
        (Register.CTRL_MODE, ControlMode.POS_FORCE, "04000000"),
        (Register.PMAX, 12.5, "00004841"),
        (Register.SN, 0xFFFFFFFF, "FFFFFFFF"),
    ],
)
def test_values_golden(register: Register, value: float, raw: str) -> None:
    assert encode_value(register, value) == bytes.fromhex(raw)
    assert decode_value(register, bytes.fromhex(raw)) == value


@given(st.sampled_from(sorted(set(REGISTERS) - INTEGERS)), st.floats(width=32, allow_nan=False))
def test_floats_round_trip(register: int, value: float) -> None:
    assert decode_value(register, encode_value(register, value)) == value


@given(st.sampled_from(sorted(INTEGERS)), st.integers(0, 2**32 - 1))
def test_integers_round_trip(register: int, value: int) -> None:
    assert decode_value(register, encode_value(register, value)) == value


def test_unknown_registers_read_as_float_and_cannot_be_written() -> None:
    assert decode_value(200, struct.pack("<f", 1.5)) == 1.5
    with pytest.raises(KeyError):
        encode_value(200, 1.5)


def test_units() -> None:
    assert pytest.approx(0.08) == 1600 * TIMEOUT_UNIT_S
    assert CAN_BITRATES[4] == 1_000_000
    assert CAN_BITRATES[9] == 5_000_000
