"""The PDOs of an emulated CANopen node: frames to values of its dictionary and back, as they are mapped (CiA 301)."""

import struct

from robotctl.hal.can.cia402.objects import (
    BITS,
    INVALID,
    MOST_MAPPED,
    RPDO_MAPPINGS,
    RPDO_PARAMETERS,
    TPDO_MAPPINGS,
    TPDO_PARAMETERS,
    Entry,
    mapped,
)
from robotctl.sim.motors.dictionary import (
    CANNOT_BE_MAPPED,
    FORMS,
    NOT_IN_THIS_STATE,
    TOO_LONG_TO_MAP,
    Abort,
    Dictionary,
    Key,
)

LAST_SYNCHRONOUS = 240
COUNT = 2
"""PDOs in either direction."""
RECORDS = tuple(
    (communication + number, mapping + number)
    for communication, mapping in ((RPDO_PARAMETERS, RPDO_MAPPINGS), (TPDO_PARAMETERS, TPDO_MAPPINGS))
    for number in range(COUNT)
)


class Pdo:
    """One PDO, as the dictionary says at present."""

    def __init__(self, dictionary: Dictionary, communication: int, mapping: int) -> None:
        self._dictionary = dictionary
        self._communication = communication
        self._mapping = mapping
        self.adopt()

    def adopt(self) -> None:
        """Look at the dictionary again."""
        values, entries = self._dictionary.values, self._dictionary.entries
        cob_id = values[self._communication, 1]
        self.is_valid = not cob_id & INVALID
        self.cob_id = cob_id & 0x7FF
        self.is_synchronous = values[self._communication, 2] <= LAST_SYNCHRONOUS
        count = values[self._mapping, 0]
        words = [values[self._mapping, sub] for sub in range(1, count + 1)]
        self.keys: list[Key] = [(word >> 16, word >> 8 & 0xFF) for word in words]
        self.form = struct.Struct("<" + "".join(FORMS[entries[key].type] for key in self.keys))

    def pack(self) -> bytes:
        """Return the frame with the present values."""
        get = self._dictionary.get
        return self.form.pack(*[get(key) for key in self.keys])

    def unpack(self, data: bytes) -> list[tuple[Key, int]]:
        """Return what a frame sets; nothing if it is too short."""
        if len(data) < self.form.size:
            return []
        return list(zip(self.keys, self.form.unpack_from(data), strict=True))


def check_write(dictionary: Dictionary, entry: Entry, value: int, *, operational: bool) -> None:
    """Refuse what CiA 301 does not allow of a PDO's parameters: changes while it is valid, mappings that cannot be.

    Raises:
        Abort: with the standard's code.
    """
    for communication, mapping in RECORDS:
        if entry.index not in (communication, mapping):
            continue
        if operational:
            raise Abort(NOT_IN_THIS_STATE)
        if entry.index == communication:
            continue
        if not dictionary.values[communication, 1] & INVALID:
            raise Abort(NOT_IN_THIS_STATE)
        if entry.sub and dictionary.values[mapping, 0]:
            raise Abort(NOT_IN_THIS_STATE)
        if entry.sub:
            target = dictionary.entries.get((value >> 16, value >> 8 & 0xFF))
            if target is None or mapped(target) != value:
                raise Abort(CANNOT_BE_MAPPED)
        elif value > MOST_MAPPED or _bits(dictionary, mapping, value) > 64:
            raise Abort(TOO_LONG_TO_MAP)


def _bits(dictionary: Dictionary, mapping: int, count: int) -> int:
    total = 0
    for sub in range(1, count + 1):
        word = dictionary.values[mapping, sub]
        entry = dictionary.entries.get((word >> 16, word >> 8 & 0xFF))
        if entry is None:
            raise Abort(CANNOT_BE_MAPPED)
        total += BITS[entry.type]
    return total
