"""The register map of DAMIAO drives: number, name, type and access."""

import struct
from enum import IntEnum
from typing import NamedTuple


class Register(IntEnum):
    """Registers that this package uses by name; the whole map is `REGISTERS`."""

    UV_VALUE = 0
    MST_ID = 7
    ESC_ID = 8
    TIMEOUT = 9
    CTRL_MODE = 10
    HW_VER = 13
    SW_VER = 14
    SN = 15
    PMAX = 21
    VMAX = 22
    TMAX = 23
    CAN_BR = 35
    SUB_VER = 36
    VBUS = 60
    P_M = 80
    XOUT = 81


class ControlMode(IntEnum):
    """Values of CTRL_MODE."""

    MIT = 1
    POS_VEL = 2
    VEL = 3
    POS_FORCE = 4


TIMEOUT_UNIT_S = 50e-6
"""One count of TIMEOUT; 0 switches the watchdog off."""

CAN_BITRATES = (125_000, 200_000, 250_000, 500_000, 1_000_000, 2_000_000, 2_500_000, 3_200_000, 4_000_000, 5_000_000)
"""By code in CAN_BR. Above 1 Mbit/s a drive answers in CAN FD, even to classic frames."""


class RegisterInfo(NamedTuple):
    """One row of the map."""

    name: str
    integer: bool
    """uint32 if true, float32 if not."""
    writable: bool = True


REGISTERS: dict[int, RegisterInfo] = {
    0: RegisterInfo("UV_Value", integer=False),
    1: RegisterInfo("KT_Value", integer=False),
    2: RegisterInfo("OT_Value", integer=False),
    3: RegisterInfo("OC_Value", integer=False),
    4: RegisterInfo("ACC", integer=False),
    5: RegisterInfo("DEC", integer=False),
    6: RegisterInfo("MAX_SPD", integer=False),
    7: RegisterInfo("MST_ID", integer=True),
    8: RegisterInfo("ESC_ID", integer=True),
    9: RegisterInfo("TIMEOUT", integer=True),
    10: RegisterInfo("CTRL_MODE", integer=True),
    11: RegisterInfo("Damp", integer=False, writable=False),
    12: RegisterInfo("Inertia", integer=False, writable=False),
    13: RegisterInfo("hw_ver", integer=True, writable=False),
    14: RegisterInfo("sw_ver", integer=True, writable=False),
    15: RegisterInfo("SN", integer=True, writable=False),
    16: RegisterInfo("NPP", integer=True, writable=False),
    17: RegisterInfo("Rs", integer=False, writable=False),
    18: RegisterInfo("Ls", integer=False, writable=False),
    19: RegisterInfo("Flux", integer=False, writable=False),
    20: RegisterInfo("Gr", integer=False, writable=False),
    21: RegisterInfo("PMAX", integer=False),
    22: RegisterInfo("VMAX", integer=False),
    23: RegisterInfo("TMAX", integer=False),
    24: RegisterInfo("I_BW", integer=False),
    25: RegisterInfo("KP_ASR", integer=False),
    26: RegisterInfo("KI_ASR", integer=False),
    27: RegisterInfo("KP_APR", integer=False),
    28: RegisterInfo("KI_APR", integer=False),
    29: RegisterInfo("OV_Value", integer=False),
    30: RegisterInfo("GREF", integer=False),
    31: RegisterInfo("Deta", integer=False),
    32: RegisterInfo("V_BW", integer=False),
    33: RegisterInfo("IQ_c1", integer=False),
    34: RegisterInfo("VL_c1", integer=False),
    35: RegisterInfo("can_br", integer=True),
    36: RegisterInfo("sub_ver", integer=True, writable=False),
    50: RegisterInfo("u_off", integer=False, writable=False),
    51: RegisterInfo("v_off", integer=False, writable=False),
    52: RegisterInfo("k1", integer=False, writable=False),
    53: RegisterInfo("k2", integer=False, writable=False),
    54: RegisterInfo("m_off", integer=False, writable=False),
    55: RegisterInfo("dir", integer=False, writable=False),
    56: RegisterInfo("motor_off", integer=False, writable=False),
    59: RegisterInfo("Imax", integer=False, writable=False),
    60: RegisterInfo("VBus", integer=False, writable=False),
    61: RegisterInfo("T_pcb", integer=False, writable=False),
    62: RegisterInfo("T_mtr", integer=False, writable=False),
    63: RegisterInfo("Iu_off", integer=False, writable=False),
    64: RegisterInfo("Iv_off", integer=False, writable=False),
    65: RegisterInfo("Iw_off", integer=False, writable=False),
    80: RegisterInfo("p_m", integer=False, writable=False),
    81: RegisterInfo("xout", integer=False, writable=False),
}
"""Vendor register list as in openarm_can and python-damiao-driver; 56 and 59 to 65 exist on newer firmware only."""


def decode_value(register: int, raw: bytes) -> float:
    """Return the number in the four value bytes of a register frame; unknown registers read as float."""
    info = REGISTERS.get(register)
    return float(struct.unpack("<I" if info and info.integer else "<f", raw)[0])


def encode_value(register: int, value: float) -> bytes:
    """Return the four value bytes of a number.

    Raises:
        KeyError: if there is no such register.
    """
    return struct.pack("<I", int(value)) if REGISTERS[register].integer else struct.pack("<f", value)
