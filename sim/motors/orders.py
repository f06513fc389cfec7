"""Trouble and register presets as words on a command line."""

from collections.abc import Callable, Iterable, Sequence

from robotctl.hal.can.cia402.objects import Entry
from robotctl.hal.can.damiao.registers import REGISTERS
from robotctl.hal.errors import ConfigError
from robotctl.sim.motors.bench import Bench
from robotctl.sim.motors.cia402 import Cia402Drive
from robotctl.sim.motors.damiao import DamiaoDrive
from robotctl.sim.motors.drive import EmulatedDrive
from robotctl.sim.motors.memory import accepts
from robotctl.sim.motors.trouble import (
    Corrupt,
    Deaf,
    Delay,
    Drop,
    Duplicate,
    Failure,
    Mute,
    PowerCut,
    Runaway,
    Stuck,
    Trouble,
    UnderVoltage,
    Unterminated,
    WrongZero,
)

_KINDS: dict[str, tuple[type[Trouble], str, Callable[[str], float]]] = {
    "mute": (Mute, "", float),
    "deaf": (Deaf, "", float),
    "drop": (Drop, "probability", float),
    "delay": (Delay, "delay_s", float),
    "unterminated": (Unterminated, "probability", float),
    "duplicate": (Duplicate, "probability", float),
    "corrupt": (Corrupt, "probability", float),
    "stuck": (Stuck, "", float),
    "runaway": (Runaway, "torque", float),
    "powercut": (PowerCut, "", float),
    "undervoltage": (UnderVoltage, "voltage", float),
    "zero": (WrongZero, "offset", float),
    "fault": (Failure, "status", lambda text: int(text, 0)),
}
"""Class, the field that VALUE sets, and how VALUE is read."""

TROUBLE_FORM = (
    "KIND:MOTOR[:VALUE][@FROM[-UNTIL]], where MOTOR is a joint's name, an id or `all`, and FROM and UNTIL are seconds "
    f"from the start; KIND is one of {', '.join(_KINDS)}; VALUE is the probability of drop, unterminated, duplicate "
    "and corrupt, the seconds of delay, the Nm of runaway, the volts of undervoltage, the rad of zero, the "
    "status (DAMIAO) or error code (CiA 402) of fault"
)
REGISTER_FORM = (
    "MOTOR:REGISTER=VALUE, where MOTOR is a joint's name, an id or `all`, and REGISTER a number or a name, or the "
    "INDEX or INDEX.SUB of an object of a CiA 402 drive"
)


def give_orders(benches: Sequence[Bench], registers: Iterable[str], troubles: Iterable[str]) -> None:
    """Do what orders ask for on every bus that has the motor. Raises as `order_register` and `order_trouble` do."""
    for order in registers:
        for bench in _meant(benches, order.partition(":")[0]):
            order_register(bench, order)
    for order in troubles:
        _, _, rest = order.partition("@")[0].partition(":")
        for bench in _meant(benches, rest.partition(":")[0]):
            order_trouble(bench, order)


def order_trouble(bench: Bench, order: str) -> None:
    """Plant the trouble that an order asks for.

    Raises:
        ConfigError: if it does not have the form `TROUBLE_FORM`.
    """
    start = bench.now_ns
    words, _, span = order.partition("@")
    kind, *rest = words.split(":")
    if kind not in _KINDS or len(rest) not in (1, 2):
        raise ConfigError(f"trouble {order!r} is not understood", f"write {TROUBLE_FORM}")
    trouble, field, read = _KINDS[kind]
    values: dict[str, float] = {}
    try:
        if len(rest) == 2:
            if not field:
                raise ValueError(f"{kind} takes no value")
            values[field] = read(rest[1])
        if span:
            begin, _, end = span.partition("-")
            values["from_ns"] = start + round(float(begin) * 1e9)
            if end:
                values["until_ns"] = start + round(float(end) * 1e9)
    except ValueError as error:
        raise ConfigError(f"trouble {order!r}: {error}", f"write {TROUBLE_FORM}") from error
    for motor in _motors(bench, rest[0]):
        bench.trouble.add(trouble(motor_id=motor.id, **values))  # type: ignore[arg-type]


def order_register(bench: Bench, order: str) -> None:
    """Set a register or an object, in RAM and in store, as an order asks for.

    Raises:
        ConfigError: if it does not have the form `REGISTER_FORM`, or no drive takes such a value.
    """
    motor, _, assignment = order.partition(":")
    name, _, text = assignment.partition("=")
    for drive in _motors(bench, motor):
        try:
            if isinstance(drive, Cia402Drive):
                drive.preset(_entry(drive, name), int(text, 0))
            elif isinstance(drive, DamiaoDrive):
                drive.preset(*_register(name, text))
        except ValueError as error:
            raise ConfigError(f"register {order!r} is not understood: {error}", f"write {REGISTER_FORM}") from error
        except LookupError as error:
            raise ConfigError(f"register {order!r}: no drive has that", "see the vendor's list of registers") from error


def _register(name: str, text: str) -> tuple[int, float]:
    """Return a register of a DAMIAO drive and its value; LookupError if it takes none such."""
    names = {info.name.lower(): register for register, info in REGISTERS.items()}
    register = names[name.lower()] if name.lower() in names else int(name, 0)
    value = float(int(text, 0)) if register in REGISTERS and REGISTERS[register].integer else float(text)
    if register not in REGISTERS or (REGISTERS[register].writable and not accepts(register, value)):
        raise LookupError(register)
    return register, value


def _entry(drive: Cia402Drive, name: str) -> Entry:
    """Return an object of a CiA 402 drive, by INDEX or INDEX.SUB; LookupError if it has none such."""
    index, _, sub = name.partition(".")
    return drive.dictionary.entries[int(index, 0), int(sub, 0) if sub else 0]


def _meant(benches: Sequence[Bench], word: str) -> list[Bench]:
    """Return the benches that have a motor; the first one where none has, since it will tell."""
    return [bench for bench in benches if word == "all" or _has(bench, word)] or [benches[0]]


def _has(bench: Bench, word: str) -> bool:
    try:
        return bool(_motors(bench, word))
    except ConfigError:
        return False


def _motors(bench: Bench, word: str) -> list[EmulatedDrive]:
    if word == "all":
        return list(bench.drives)
    try:
        return [bench.drive(int(word, 0))]
    except ValueError:
        return [bench.drive(word)]
