"""CiA 402 drives without a bus: frames that were recorded are decoded by the very code that decoded them live."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from robotctl.hal.can.channel import Channel
from robotctl.hal.can.cia402.drive import Drive
from robotctl.hal.can.cia402.network import HostNetwork
from robotctl.hal.can.damiao.replay import NoBus
from robotctl.hal.can.transport import Transport
from robotctl.hal.clock import VirtualClock
from robotctl.hal.profile import Cia402Drive
from robotctl.hal.types import Vector


def describe(drives: Sequence[Drive]) -> dict[str, Any]:
    """Return what it takes to decode the feedback of an arm's drives."""
    return {
        "protocol": "cia402",
        "joints": len(drives),
        "drives": [{"name": drive.name, **drive.wiring.model_dump(mode="json")} for drive in drives],
    }


class Replayed402:
    """The drives of a description."""

    def __init__(self, description: Mapping[str, Any]) -> None:
        """Build them from what `describe` returned."""
        clock = VirtualClock()
        self._transport = Transport(Channel(NoBus(), fd=False, simulated=True), clock)
        network = HostNetwork(self._transport, clock, beats=False)
        self._drives = [
            Drive(
                wiring["name"], Cia402Drive(**{key: value for key, value in wiring.items() if key != "name"}), network
            )
            for wiring in description["drives"]
        ]

    def accept(self, arbitration_id: int, data: bytes, stamp_ns: int) -> None:
        """Take a frame that the host had received."""
        route = self._transport.by_id.get(arbitration_id)
        if route is not None:
            route(bytearray(data), stamp_ns)

    def state(self) -> tuple[Vector, Vector, Vector]:
        """Return position, velocity and effort of the joints, (n,) each."""
        drives = self._drives
        return (
            np.array([drive.position for drive in drives]),
            np.array([drive.velocity for drive in drives]),
            np.array([drive.effort for drive in drives]),
        )
