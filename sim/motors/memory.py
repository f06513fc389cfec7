"""The registers of an emulated drive: a copy in RAM, a copy in flash, and a count of the writes the flash has had."""

from collections.abc import Mapping

from robotctl.hal.can.damiao.motors import MOTORS
from robotctl.hal.can.damiao.registers import (
    CAN_BITRATES,
    REGISTERS,
    ControlMode,
    Register,
    decode_value,
    encode_value,
)

NOMINAL_VOLTAGE = 24.0
"""Supply of a drive, V."""

FLASH_CYCLES = 10_000
"""Writes the vendor promises."""

CAN_BR_1M = CAN_BITRATES.index(1_000_000)
CAN_BR_5M = CAN_BITRATES.index(5_000_000)
_FASTER_CODES = (10, 11)
"""8 and 10 Mbit/s, newer firmware only; a drive that has stored one falls back to 1 Mbit/s at power-up."""


def factory_values(
    motor: str, motor_id: int, reply_id: int, mode: ControlMode, timeout: int, fd: bool
) -> dict[int, float]:
    """Return plausible contents of the flash of a drive as an integrator leaves it.

    `timeout` is the watchdog's, in counts of 50 us; `fd` sets CAN FD at 5 Mbit/s, else classic at 1 Mbit/s.
    """
    pmax, vmax, tmax = MOTORS[motor]
    values = dict.fromkeys(REGISTERS, 0.0)
    values |= {0: 15.0, 1: 0.945, 2: 100.0, 3: 0.98, 4: 50.0, 5: -50.0, 6: vmax, 11: 1e-4, 12: 4e-5, 16: 14, 17: 0.65}
    values |= {18: 3e-4, 19: 4.5e-3, 20: 10.0, 24: 1000.0, 25: 4e-3, 26: 2e-3, 27: 50.0, 28: 0.1, 29: 32.0, 30: 1.0}
    values |= {31: 4.0, 32: 1000.0, 33: 1.0, 34: 2e-3, 54: 0.0, 55: 1.0, 59: 10.26}
    values |= {Register.VBUS: NOMINAL_VOLTAGE}
    return values | {
        Register.MST_ID: reply_id,
        Register.ESC_ID: motor_id,
        Register.TIMEOUT: timeout,
        Register.CTRL_MODE: mode,
        Register.HW_VER: 0x0300,
        Register.SW_VER: 5017,
        Register.SN: 0x2600_0000 + motor_id,
        Register.PMAX: pmax,
        Register.VMAX: vmax,
        Register.TMAX: tmax,
        Register.CAN_BR: CAN_BR_5M if fd else CAN_BR_1M,
        Register.SUB_VER: 1,
    }


class Memory:
    """Values as they stand on the wire: integers, and floats of 32 bits."""

    def __init__(self, values: Mapping[int, float]) -> None:
        """Start with `values` in flash and in RAM."""
        self._flash = {register: _as_stored(register, value) for register, value in values.items()}
        self._ram = dict(self._flash)
        self.cycles = 0
        """Times the flash was written."""

    def __getitem__(self, register: int) -> float:
        return self._ram[register]

    def __contains__(self, register: int) -> bool:
        return register in self._ram

    def write(self, register: int, value: float) -> None:
        """Set a value in RAM, whether or not a host may."""
        self._ram[register] = _as_stored(register, value)

    def preset(self, register: int, value: float) -> None:
        """Set a value in flash and in RAM without a write cycle, as if the drive had come that way."""
        self._flash[register] = self._ram[register] = _as_stored(register, value)

    def save(self) -> None:
        """Copy the RAM to the flash."""
        self._flash = dict(self._ram)
        self.cycles += 1

    def power_up(self) -> None:
        """Copy the flash to the RAM."""
        self._ram = dict(self._flash)
        if self._ram[Register.CAN_BR] in _FASTER_CODES:
            self._ram[Register.CAN_BR] = float(CAN_BR_1M)


def accepts(register: int, value: float) -> bool:
    """Return whether a drive takes this value from a host. Sources: the vendor's list of ranges."""
    info = REGISTERS.get(register)
    if info is None or not info.writable or value != value or abs(value) == float("inf"):
        return False
    match register:
        case Register.CTRL_MODE:
            return value in tuple(ControlMode)
        case Register.MST_ID | Register.ESC_ID:
            return 0 <= value <= 0x7FF
        case Register.PMAX | Register.VMAX | Register.TMAX:
            return value > 0.0
        case Register.CAN_BR:
            return value < len(CAN_BITRATES) or value in _FASTER_CODES
        case _:
            return True


def _as_stored(register: int, value: float) -> float:
    return decode_value(register, encode_value(register, value))
