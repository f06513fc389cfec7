"""A drive that answered when its bus was scanned."""

from dataclasses import dataclass

from robotctl.hal.can.damiao.drive import Identity


@dataclass(frozen=True, slots=True)
class FoundMotor:
    """A drive that answered. What its protocol, or its firmware, does not tell stays at its default."""

    id: int
    reply_ids: tuple[int, ...]
    """More than one: several motors share the id."""
    identity: Identity | None = None
    """None if it answered once and then no more."""
    bitrate: int = 0
    """bit/s, 0 if unknown. Above 1 Mbit/s a DAMIAO drive answers in CAN FD."""
    position: float = float("nan")
    """Motor angle, rad."""
    mosfet_temperature: int = 0
    """degrees Celsius"""
    rotor_temperature: int = 0
    """degrees Celsius"""
    status: str = ""
    models: tuple[str, ...] = ()
    """Motors that have these ranges: a guess, since the drive does not tell."""
    voltage: float | None = None
    """Supply, V; None on firmware that does not measure it for others."""
    least_voltage: float | None = None
    """Supply below which it switches itself off, V."""
    asked: int = 0
    """Feedback requests ..."""
    heard: int = 0
    """... and how many were answered."""
    protocol: str = "damiao"

    @property
    def lost(self) -> float:
        """Share of the requests that stayed unanswered, 0 to 1."""
        return max(0.0, 1.0 - self.heard / self.asked) if self.asked else 0.0
