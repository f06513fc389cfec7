"""The object dictionary entries that this package reads or writes. Sources: CiA 301, IEC 61800-7-201."""

from dataclasses import dataclass

from canopen import ObjectDictionary
from canopen.objectdictionary import ODRecord, ODVariable, datatypes

U8, U16, U32 = datatypes.UNSIGNED8, datatypes.UNSIGNED16, datatypes.UNSIGNED32
I8, I16, I32 = datatypes.INTEGER8, datatypes.INTEGER16, datatypes.INTEGER32
BITS = {U8: 8, U16: 16, U32: 32, I8: 8, I16: 16, I32: 32}


@dataclass(frozen=True, slots=True)
class Entry:
    """One value of an object dictionary."""

    index: int
    sub: int
    type: int
    name: str
    writable: bool = False
    in_record: bool = False
    """Whether its object has several values."""

    def __str__(self) -> str:
        return f"0x{self.index:04X}{f':{self.sub}' if self.in_record else ''} ({self.name})"


DEVICE_TYPE = Entry(0x1000, 0, U32, "device type")
ERROR_REGISTER = Entry(0x1001, 0, U8, "error register")
HEARTBEAT_CONSUMER = Entry(0x1016, 1, U32, "consumer heartbeat time", writable=True, in_record=True)
HEARTBEAT_PRODUCER = Entry(0x1017, 0, U16, "producer heartbeat time", writable=True)
VENDOR = Entry(0x1018, 1, U32, "vendor id", in_record=True)
PRODUCT = Entry(0x1018, 2, U32, "product code", in_record=True)
REVISION = Entry(0x1018, 3, U32, "revision number", in_record=True)
SERIAL = Entry(0x1018, 4, U32, "serial number", in_record=True)
ABORT_OPTION = Entry(0x6007, 0, I16, "abort connection option code", writable=True)
ERROR_CODE = Entry(0x603F, 0, U16, "error code")
CONTROLWORD = Entry(0x6040, 0, U16, "controlword", writable=True)
STATUSWORD = Entry(0x6041, 0, U16, "statusword")
QUICK_STOP_OPTION = Entry(0x605A, 0, I16, "quick stop option code", writable=True)
MODE = Entry(0x6060, 0, I8, "modes of operation", writable=True)
MODE_DISPLAY = Entry(0x6061, 0, I8, "modes of operation display")
POSITION = Entry(0x6064, 0, I32, "position actual value")
VELOCITY = Entry(0x606C, 0, I32, "velocity actual value")
TARGET_TORQUE = Entry(0x6071, 0, I16, "target torque", writable=True)
MAX_TORQUE = Entry(0x6072, 0, U16, "max torque", writable=True)
RATED_TORQUE = Entry(0x6076, 0, U32, "motor rated torque", writable=True)
TORQUE = Entry(0x6077, 0, I16, "torque actual value")
TARGET_POSITION = Entry(0x607A, 0, I32, "target position", writable=True)
MAX_MOTOR_SPEED = Entry(0x6080, 0, U32, "max motor speed", writable=True)
INCREMENTS = Entry(0x608F, 1, U32, "encoder increments", writable=True, in_record=True)
REVOLUTIONS = Entry(0x608F, 2, U32, "motor revolutions", writable=True, in_record=True)
VELOCITY_UNIT = Entry(0x60A9, 0, U32, "SI unit velocity", writable=True)
VELOCITY_OFFSET = Entry(0x60B1, 0, I32, "velocity offset", writable=True)
TORQUE_OFFSET = Entry(0x60B2, 0, I16, "torque offset", writable=True)
CYCLE = Entry(0x60C2, 1, U8, "interpolation time period value", writable=True, in_record=True)
CYCLE_EXPONENT = Entry(0x60C2, 2, I8, "interpolation time index", writable=True, in_record=True)
TARGET_VELOCITY = Entry(0x60FF, 0, I32, "target velocity", writable=True)
SUPPORTED_MODES = Entry(0x6502, 0, U32, "supported drive modes")

ENTRIES = tuple(value for value in list(globals().values()) if isinstance(value, Entry))

DEVICE_PROFILE = 402
"""Low half of the device type."""
INCREMENTS_PER_SECOND = 0x00B50300
"""Of 0x60A9: no prefix, increments, per second."""

RPDO1 = (CONTROLWORD, MODE, TARGET_POSITION)
RPDO2 = (VELOCITY_OFFSET, TORQUE_OFFSET)
TPDO1 = (STATUSWORD, POSITION, TORQUE)
TPDO2 = (VELOCITY, MODE_DISPLAY)
RPDOS, TPDOS = (RPDO1, RPDO2), (TPDO1, TPDO2)
RPDO_PARAMETERS, RPDO_MAPPINGS, TPDO_PARAMETERS, TPDO_MAPPINGS = 0x1400, 0x1600, 0x1800, 0x1A00
MOST_MAPPED = 8
INVALID = 1 << 31
"""Bit of a PDO's COB-ID that switches it off."""
EVERY_SYNC = 1
"""Transmission type."""


def dictionary() -> ObjectDictionary:
    """Return the entries as the `canopen` package wants them, with two PDOs in either direction."""
    made = ObjectDictionary()  # type: ignore[no-untyped-call]
    records: dict[int, ODRecord] = {}
    for entry in ENTRIES:
        variable = _variable(entry.name, entry.index, entry.sub, entry.type, "rw" if entry.writable else "ro")
        if not entry.in_record:
            made.add_object(variable)
            continue
        record = records.get(entry.index)
        if record is None:
            record = records[entry.index] = _record(f"0x{entry.index:04X}", entry.index)
            made.add_object(record)
        record.add_member(variable)
    for pdo in range(2):
        for parameters, mapping in ((RPDO_PARAMETERS, RPDO_MAPPINGS), (TPDO_PARAMETERS, TPDO_MAPPINGS)):
            record = _record("PDO communication parameter", parameters + pdo)
            record.add_member(_variable("COB-ID", parameters + pdo, 1, U32))
            record.add_member(_variable("transmission type", parameters + pdo, 2, U8))
            made.add_object(record)
            record = _record("PDO mapping parameter", mapping + pdo)
            for sub in range(1, MOST_MAPPED + 1):
                record.add_member(_variable(f"mapping {sub}", mapping + pdo, sub, U32))
            made.add_object(record)
    return made


def mapped(entry: Entry) -> int:
    """Return how a PDO's mapping names an entry: index, sub-index and bits."""
    return entry.index << 16 | entry.sub << 8 | BITS[entry.type]


def _record(name: str, index: int) -> ODRecord:
    record = ODRecord(name, index)
    record.add_member(_variable("number of entries", index, 0, U8))
    return record


def _variable(name: str, index: int, sub: int, kind: int, access: str = "rw") -> ODVariable:
    variable = ODVariable(name, index, sub)
    variable.data_type = kind
    variable.access_type = access
    return variable
