"""The object dictionary of an emulated CANopen node, and the SDO server in front of it (CiA 301)."""

import struct
from collections.abc import Callable

from robotctl.hal.can.cia402.objects import ENTRIES, I8, I16, I32, MOST_MAPPED, U8, U16, U32, Entry

Key = tuple[int, int]
"""Index and sub-index."""

FORMS = {U8: "B", U16: "H", U32: "I", I8: "b", I16: "h", I32: "i"}
STORE = Entry(0x1010, 1, U32, "store parameters", writable=True, in_record=True)
_SAVE = int.from_bytes(b"save", "little")

# Abort codes of CiA 301, table 22.
UNKNOWN_COMMAND = 0x05040001
READ_ONLY = 0x06010002
NO_OBJECT = 0x06020000
CANNOT_BE_MAPPED = 0x06040041
TOO_LONG_TO_MAP = 0x06040042
WRONG_LENGTH = 0x06070010
NO_SUB_INDEX = 0x06090011
OUT_OF_RANGE = 0x06090030
NOT_STORED = 0x08000020
NOT_IN_THIS_STATE = 0x08000022


class Abort(Exception):  # noqa: N818 - the standard's name
    """An SDO transfer that is refused."""

    def __init__(self, code: int) -> None:
        super().__init__(hex(code))
        self.code = code


class Dictionary:
    """Values by index and sub-index, in RAM and stored; some are asked for when they are read."""

    def __init__(self, parameters: tuple[tuple[int, int], ...]) -> None:
        """Hold the entries of a drive, and PDO records with (communication, mapping) at these indices."""
        entries = {(entry.index, entry.sub): entry for entry in (*ENTRIES, STORE)}
        for communication, mapping in parameters:
            entries[communication, 1] = Entry(communication, 1, U32, "COB-ID", writable=True)
            entries[communication, 2] = Entry(communication, 2, U8, "transmission type", writable=True)
            for sub in range(MOST_MAPPED + 1):
                entries[mapping, sub] = Entry(mapping, sub, U32 if sub else U8, "mapping", writable=True)
        self.entries: dict[Key, Entry] = entries
        self.values: dict[Key, int] = dict.fromkeys(entries, 0)
        self.live: dict[Key, Callable[[], int]] = {}
        """Entries that are worked out when they are read."""
        self.before_write: Callable[[Entry, int], None] = lambda _entry, _value: None
        """May raise Abort."""
        self.after_write: Callable[[Entry], None] = lambda _entry: None
        self.cycles = 0
        """Times it was stored."""
        self._stored = dict(self.values)

    def __getitem__(self, entry: Entry) -> int:
        return self.get((entry.index, entry.sub))

    def __setitem__(self, entry: Entry, value: int) -> None:
        self.values[entry.index, entry.sub] = value

    def get(self, key: Key) -> int:
        """Return a value as it would be read."""
        live = self.live.get(key)
        return live() if live else self.values[key]

    def preset(self, key: Key, value: int) -> None:
        """Set a value in RAM and in store, as if the node had come that way."""
        self._stored[key] = self.values[key] = value

    def power_up(self) -> None:
        """Go back to what is stored."""
        self.values = dict(self._stored)

    def upload(self, key: Key) -> bytes:
        """Return the bytes of an entry. Raises Abort."""
        return struct.pack(f"<{FORMS[self._entry(key).type]}", self.get(key))

    def download(self, key: Key, data: bytes) -> None:
        """Write an entry. Raises Abort."""
        entry = self._entry(key)
        if not entry.writable:
            raise Abort(READ_ONLY)
        form = struct.Struct(f"<{FORMS[entry.type]}")
        if len(data) != form.size:
            raise Abort(WRONG_LENGTH)
        (value,) = form.unpack(data)
        if entry == STORE:
            if value != _SAVE:
                raise Abort(NOT_STORED)
            self._stored = dict(self.values)
            self.cycles += 1
            return
        self.before_write(entry, value)
        self.values[key] = value
        self.after_write(entry)

    def _entry(self, key: Key) -> Entry:
        entry = self.entries.get(key)
        if entry is None:
            raise Abort(NO_SUB_INDEX if any(key[0] == index for index, _ in self.entries) else NO_OBJECT)
        return entry


def serve(dictionary: Dictionary, request: bytes) -> bytes | None:
    """Return the answer to an SDO request; None if there is none to give.

    All values have at most 4 bytes, so that every transfer is expedited.
    """
    if len(request) != 8:
        return None
    command, index, sub = struct.unpack_from("<BHB", request)
    try:
        match command >> 5:
            case 2:
                data = dictionary.upload((index, sub))
                return struct.pack("<BHB", 0x43 | (4 - len(data)) << 2, index, sub) + data.ljust(4, b"\0")
            case 1:
                if not command & 0x02:
                    raise Abort(WRONG_LENGTH)
                size = 4 - (command >> 2 & 3) if command & 0x01 else 4
                dictionary.download((index, sub), bytes(request[4 : 4 + size]))
                return struct.pack("<BHBI", 0x60, index, sub, 0)
            case 4:
                return None
            case _:
                raise Abort(UNKNOWN_COMMAND)
    except Abort as abort:
        return struct.pack("<BHBI", 0x80, index, sub, abort.code)
