"""What is wrong with a bus, told from what a scan could see: who answered in which way, what got lost, error frames.

A host that is alone on a bus is acknowledged by nobody. One at a wrong bit rate is not understood by those who are
there, and breaks their frames as they break its own. Without termination frames get through, but not all.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from robotctl.hal.can.error_frames import ErrorKind
from robotctl.hal.can.found import FoundMotor
from robotctl.hal.can.transport import RoundTrip
from robotctl.hal.can.ways import Way, rate_text
from robotctl.hal.host import Finding, Level

_LOSSY = 0.05
"""Share of lost replies that is no accident."""
_TERMINATION = (
    "power off, measure 60 Ohm between CAN_H and CAN_L: 120 Ohm at each end of the cable, and nowhere else; then look "
    "at the plugs, the common ground, and the length of stubs"
)


class Attempt(NamedTuple):
    """One scan, in one way of speaking."""

    way: Way
    motors: tuple[FoundMotor, ...]
    statistics: dict[str, object]
    errors: dict[ErrorKind, int]
    """Error frames by kind."""
    last_id: int
    failure: str = ""
    """Why it was given up, if it was."""
    round_trip: RoundTrip | None = None
    """From request to reply; None if there was none."""

    @property
    def lossy(self) -> list[FoundMotor]:
        """The drives that answered, but not always."""
        return [motor for motor in self.motors if motor.lost > _LOSSY or motor.identity is None]

    @property
    def all_lossy(self) -> bool:
        """Whether so many of several drives are lossy that the bus must be."""
        return len(self.motors) > 1 and 2 * len(self.lossy) >= len(self.motors)


def bus_findings(attempts: Sequence[Attempt], blind_spots: str) -> Iterator[Finding]:
    """Yield what the attempts say of the bus; the first is the way that the profile says."""
    first = attempts[0]
    others = [attempt for attempt in attempts[1:] if attempt.motors]
    findings = [_elsewhere(first, other) for other in others]
    if first.motors:
        findings += _losses(first)
    elif not others:
        findings.append(_silence(attempts))
    findings += [finding for motor in first.motors for finding in _motor(motor)]
    if not findings:
        yield Finding("bus", "answers", Level.OK, f"{_count(first.motors)} on {first.way}, no reply lost")
    yield from findings
    if blind_spots:
        yield Finding("bus", "sight", Level.OK, blind_spots)


def _elsewhere(first: Attempt, other: Attempt) -> Finding:
    here = {motor.id for motor in first.motors}
    ids = ", ".join(f"0x{motor.id:02X}" for motor in other.motors if motor.id not in here)
    if not ids:
        return Finding("bus", "other ways", Level.OK, f"the drives answer on {other.way}, too")
    text = f"{ids}: silent on {first.way}, but answers on {other.way}"
    if other.way.fd != first.way.fd:
        remedy = (
            "a drive set above 1 Mbit/s answers in CAN FD only, one at or below in classic CAN: set register 35 "
            "(can_br) to 4 for 1 Mbit/s classic with the vendor's tool, or use an interface with CAN FD and say "
            "`fd: true` in the profile"
        )
        return Finding("bus", "CAN FD", Level.FAIL, text, remedy)
    remedy = (
        f"one rate for all: set `bitrate: {other.way.bitrate}` in the profile's can section, or register 35 (can_br) "
        f"of these drives to that of {rate_text(first.way.bitrate)} with the vendor's tool"
    )
    return Finding("bus", "bit rate", Level.FAIL, text, remedy)


def _losses(attempt: Attempt) -> list[Finding]:
    lossy = attempt.lossy
    errors = sum(attempt.errors.values())
    seen = f"; {_errors(attempt)}" if errors else ""
    if attempt.all_lossy:
        asked = sum(motor.asked for motor in attempt.motors)
        lost = asked - sum(min(motor.heard, motor.asked) for motor in attempt.motors)
        text = (
            f"{100 * lost / max(asked, 1):.0f} % of the requests stay unanswered, on {len(lossy)} of "
            f"{_count(attempt.motors)}{seen}: no termination, or a bad cable for all"
        )
        return [Finding("bus", "termination", Level.FAIL, text, _TERMINATION)]
    findings = [
        Finding(
            "bus",
            f"0x{motor.id:02X}",
            Level.WARN,
            f"{100 * motor.lost:.0f} % of its replies are lost, the others' are not"
            if motor.identity
            else "answered once and then no more",
            "its own plug and cable, or a second motor with its id",
        )
        for motor in lossy
    ]
    if errors:
        text = f"{_errors(attempt)} although replies come: noise, or a bus at its edge"
        findings.append(Finding("bus", "errors", Level.WARN, text, _TERMINATION))
    return findings


def _silence(attempts: Sequence[Attempt]) -> Finding:
    """Return the most likely reason why nobody answers in any way."""
    first = attempts[0]
    tried = ", ".join(str(attempt.way) for attempt in attempts)
    what = f"nothing answered on the ids 1 to {first.last_id} ({tried})"
    garbled, alone = first.errors.get(ErrorKind.GARBLED, 0), first.errors.get(ErrorKind.NO_ACK, 0)
    if garbled > alone:
        text = f"{what}; {_errors(first)}: somebody is there and is not understood, most likely at another bit rate"
        remedy = (
            f"the host speaks {first.way}; bring the interface up at the drives' rate (`ip link set can0 type can "
            f"bitrate 500000`, for one) and scan again. If no rate helps: {_TERMINATION}"
        )
        return Finding("bus", "bit rate", Level.FAIL, text, remedy)
    if alone or first.statistics.get("send_failures"):
        seen = _errors(first) if alone else f"{first.statistics['send_failures']} frames could not be sent"
        text = f"{what}; {seen}: nobody acknowledges, the host is alone on the bus"
        return Finding(
            "bus", "power", Level.FAIL, text, f"drives' power, e-stop released, CAN_H and CAN_L; {_TERMINATION}"
        )
    remedy = (
        f"in this order: are the drives powered, is the e-stop released; the cable and common ground; {_TERMINATION}"
    )
    remedy += "; last, a bit rate or CAN FD setting that was not tried"
    return Finding("bus", "silence", Level.FAIL, what, remedy)


def _motor(motor: FoundMotor) -> Iterator[Finding]:
    who = f"0x{motor.id:02X}"
    if len(motor.reply_ids) > 1:
        listed = ", ".join(f"0x{reply:02X}" for reply in motor.reply_ids)
        text = f"{len(motor.reply_ids)} motors share this id (replies on {listed})"
        yield Finding("bus", who, Level.FAIL, text, "unplug all but one, and `robotctl motor set-id` each in turn")
    if motor.identity and motor.identity.timeout_s == 0.0:
        text = "its watchdog is off: it would go on when the host dies"
        yield Finding("bus", who, Level.WARN, text, f"`robotctl motor set-watchdog 0x{motor.id:02X} 100`")


def _errors(attempt: Attempt) -> str:
    return ", ".join(f"{count} x {kind}" for kind, count in attempt.errors.items())


def _count(motors: Sequence[FoundMotor]) -> str:
    return f"{len(motors)} drive{'' if len(motors) == 1 else 's'}"
