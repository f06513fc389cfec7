"""The ways a channel can be spoken on, and what it cannot show: which mistakes can be told apart depends on both."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import can

from robotctl.hal.can.channel import Channel, open_wired, options
from robotctl.hal.profile import CanBus

_RATES = (1_000_000, 500_000, 250_000, 125_000)
"""Nominal bit rates that both DAMIAO drives and slcan adapters know."""

_ADAPTER_CLOCK = 80_000_000
"""Any will do: an slcan adapter is told the two rates alone."""


class Way(NamedTuple):
    """A nominal bit rate, and whether CAN FD is understood."""

    bitrate: int
    fd: bool

    def __str__(self) -> str:
        return f"{'CAN FD' if self.fd else 'classic CAN'} at {rate_text(self.bitrate)}"


def rate_text(bitrate: int) -> str:
    """Return a bit rate for people."""
    return f"{bitrate / 1e6:g} Mbit/s" if bitrate >= 1_000_000 else f"{bitrate / 1e3:g} kbit/s"


def own_way(name: str, wiring: CanBus) -> Way:
    """Return how `open_channel` speaks on a channel."""
    return Way(wiring.bitrate, wiring.fd and not name.startswith("slcan:"))


def other_ways(name: str, wiring: CanBus) -> list[Way]:
    """Return the ways that a program may choose beside `own_way`, the likely ones first.

    A kernel interface keeps the bit rate that it was brought up with; whether CAN FD is heard is up to the program.
    """
    own = own_way(name, wiring)
    match name.partition(":")[0]:
        case "slcan":
            every = [Way(wiring.bitrate, True), *(Way(rate, False) for rate in _RATES)]
        case "socketcan":
            every = [Way(wiring.bitrate, not own.fd)]
        case "pcan" | "kvaser" | "ixxat" | "vector" | "gs_usb" | "canalystii" | "nican" | "usb2can" | "seeedstudio":
            every = [Way(rate, own.fd) for rate in _RATES]
        case _:
            every = []
    return [way for way in every if way != own]


def open_way(name: str, wiring: CanBus, way: Way) -> Channel:
    """Open a channel in another way than the profile's.

    Raises:
        BusError: if it cannot be opened.
    """
    wired = wiring.model_copy(update={"bitrate": way.bitrate, "fd": way.fd})
    chosen: Mapping[str, Any] = options(name.partition(":")[0], wired)
    if name.startswith("slcan:") and way.fd:
        timing = can.BitTimingFd.from_sample_point(_ADAPTER_CLOCK, way.bitrate, 75.0, wired.data_bitrate, 75.0)
        chosen = {key: value for key, value in chosen.items() if key != "bitrate"} | {"timing": timing}
    channel = open_wired(name, wired, chosen)
    return Channel(channel.bus, fd=way.fd)


def blind_spots(name: str) -> str:
    """Return what cannot be seen on a channel of this kind; empty where a controller tells everything."""
    interface, _, where = name.partition(":")
    if interface == "slcan":
        return (
            "a serial adapter tells of no errors and no acknowledgements: silence and lost replies are all that shows, "
            "so that no power, no termination and a cut cable look much alike"
        )
    if interface == "socketcan" and Path("/sys/devices/virtual/net", where).exists():
        return "a virtual interface has no wire and no bit rate: its error frames are those that somebody sends"
    if interface in ("emulated", "virtual"):
        return "there is no wire behind this channel: bit rate and termination are those of the emulation"
    return ""
