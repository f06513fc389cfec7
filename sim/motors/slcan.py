"""The ASCII protocol of serial CAN adapters (LAWICEL CAN232, with the CAN FD commands of the CANable 2.0 firmware).

A command ends with CR. The answer is CR or, for what is refused, BEL. Frames that arrive are sent as the very command
that would send them. Pure state, no I/O.
"""

import can

OK = b"\r"
REFUSED = b"\a"

LONGEST_LINE = 160
"""A frame of 64 bytes with an extended id takes 138 characters."""

_BITRATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)
"""By the digit of the command S."""

_FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Data length by DLC."""

_DATA_RATES = {b"Y2": 2_000_000, b"Y5": 5_000_000}
_SETTINGS = frozenset(b"MmWQUX")
"""Commands for acceptance filters, auto start, serial speed and auto poll: taken, and of no effect here."""

_TIMER_PERIOD_MS = 60_000


class SlcanAdapter:
    """An adapter on a bus whose nominal bit rate is `bus_bitrate`. At another rate it hears and says nothing.

    None leaves it to whoever runs the bus to see who understands whom.
    """

    def __init__(self, bus_bitrate: int | None = 1_000_000) -> None:
        self.is_open = False
        self.fd = False
        """Whether the host has set a data rate: without one, CAN FD frames do not pass."""
        self.bitrate = bus_bitrate or 1_000_000
        """What the host has set, bit/s."""
        self._bus_bitrate = bus_bitrate
        self._listen_only = False
        self._stamps = False
        self._buffer = bytearray()

    def reset(self) -> None:
        """Close the channel and forget half a command, as when the host's end was closed."""
        self.is_open = self._listen_only = False
        self._buffer.clear()

    def feed(self, data: bytes) -> tuple[bytes, list[can.Message]]:
        """Take bytes from the host; return the answers, and the frames to put on the bus."""
        answers = b""
        frames = []
        for byte in data:
            if byte != ord("\r"):
                self._buffer.append(byte)
                if len(self._buffer) > LONGEST_LINE:
                    self._buffer.clear()
                    answers += REFUSED
                continue
            line = bytes(self._buffer)
            self._buffer.clear()
            try:
                answer, frame = self._command(line)
            except (ValueError, IndexError):
                # Not hexadecimal, or too short.
                answer, frame = REFUSED, None
            answers += answer
            if frame is not None:
                frames.append(frame)
        return answers, frames

    def encode(self, frame: can.Message) -> bytes:
        """Return what the host is told of a frame on the bus; nothing if the adapter cannot receive it."""
        if not self.is_open or not self._understood or frame.is_error_frame or (frame.is_fd and not self.fd):
            return b""
        if frame.is_remote_frame:
            letter = "r"
        elif frame.is_fd:
            letter = "b" if frame.bitrate_switch else "d"
        else:
            letter = "t"
        if frame.is_extended_id:
            head = f"{letter.upper()}{frame.arbitration_id:08X}"
        else:
            head = f"{letter}{frame.arbitration_id:03X}"
        dlc = _FD_LENGTHS.index(frame.dlc)
        data = "" if frame.is_remote_frame else frame.data.hex().upper()
        stamp = f"{int(frame.timestamp * 1e3) % _TIMER_PERIOD_MS:04X}" if self._stamps else ""
        return f"{head}{dlc:X}{data}{stamp}\r".encode()

    @property
    def _understood(self) -> bool:
        return self._bus_bitrate in (None, self.bitrate)

    def _command(self, line: bytes) -> tuple[bytes, can.Message | None]:
        """Return the answer to one command, and the frame that it sends."""
        letter = line[:1]
        if not letter:
            return OK, None
        if letter in b"tTrRdDbB":
            return self._transmit(line)
        match letter:
            case b"O" | b"L":
                if self.is_open:
                    return REFUSED, None
                self.is_open, self._listen_only = True, letter == b"L"
                return OK, None
            case b"C":
                answer = OK if self.is_open else REFUSED
                self.is_open = self._listen_only = False
                return answer, None
            case b"V":
                return b"V1013\r", None
            case b"v":
                return b"v0100\r", None
            case b"N":
                return b"NROBO\r", None
            case b"F":
                return (b"F00\r" if self.is_open else REFUSED), None
            case _:
                return (REFUSED if self.is_open else self._configure(letter, line)), None

    def _configure(self, letter: bytes, line: bytes) -> bytes:
        """Return the answer to a command that is allowed while the channel is closed."""
        match letter:
            case b"S":
                self.bitrate = _BITRATES[int(line[1:])]
                self.fd = False
            case b"s":
                self.bitrate = _from_registers(int(line[1:3], 16), int(line[3:5], 16))
                self.fd = False
            case b"Y":
                if line not in _DATA_RATES:
                    return REFUSED
                self.fd = True
            case b"Z":
                self._stamps = line == b"Z1"
            case _:
                return OK if letter[0] in _SETTINGS else REFUSED
        return OK

    def _transmit(self, line: bytes) -> tuple[bytes, can.Message | None]:
        if not self.is_open or self._listen_only:
            return REFUSED, None
        kind = chr(line[0])
        extended = kind.isupper()
        fd = kind in "dDbB"
        if fd and not self.fd:
            return REFUSED, None
        digits = 8 if extended else 3
        arbitration_id = int(line[1 : 1 + digits], 16)
        if arbitration_id > (0x1FFFFFFF if extended else 0x7FF):
            return REFUSED, None
        code = int(line[1 + digits : 2 + digits], 16)
        if not fd and code > 8:
            return REFUSED, None
        remote = kind in "rR"
        length = 0 if remote else _FD_LENGTHS[code]
        data = bytes.fromhex(line[2 + digits : 2 + digits + 2 * length].decode("ascii"))
        if len(data) != length or len(line) != 2 + digits + 2 * length:
            return REFUSED, None
        answer = b"Z\r" if extended else b"z\r"
        if not self._understood:
            # Nobody understands it, so nobody acknowledges; the adapter has taken it all the same.
            return answer, None
        frame = can.Message(
            arbitration_id=arbitration_id,
            is_extended_id=extended,
            is_remote_frame=remote,
            dlc=_FD_LENGTHS[code],
            data=data,
            is_fd=fd,
            bitrate_switch=kind in "bB",
        )
        return answer, frame


def _from_registers(btr0: int, btr1: int) -> int:
    """Return the bit rate that the SJA1000's registers BTR0 and BTR1 set, with its clock of 8 MHz."""
    prescaler = (btr0 & 0x3F) + 1
    quanta = 1 + (btr1 & 0xF) + 1 + (btr1 >> 4 & 0x7) + 1
    return 8_000_000 // (prescaler * quanta)
