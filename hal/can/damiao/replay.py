"""DAMIAO drives without a bus: frames that were recorded are decoded by the very code that decoded them live."""

from collections.abc import Mapping, Sequence
from typing import Any

import can
import numpy as np

from robotctl.hal.can.channel import Channel
from robotctl.hal.can.damiao.drive import Drive
from robotctl.hal.can.damiao.motors import Ranges
from robotctl.hal.can.transport import Transport, route_key
from robotctl.hal.clock import VirtualClock
from robotctl.hal.types import Vector


def describe(drives: Sequence[Drive], joints: int) -> dict[str, Any]:
    """Return what it takes to decode the feedback of drives, of which the first `joints` are an arm's."""
    return {
        "protocol": "damiao",
        "joints": joints,
        "drives": [
            {
                "name": drive.name,
                "id": drive.id,
                "reply_id": drive.reply_id,
                "ranges": list(drive.ranges),
                "scale": drive.scale,
                "zero": drive.zero,
                "fold": drive.fold,
            }
            for drive in drives
        ],
    }


class ReplayedDrives:
    """The drives of a description."""

    def __init__(self, description: Mapping[str, Any]) -> None:
        """Build them from what `describe` returned."""
        clock = VirtualClock()
        self._transport = Transport(Channel(NoBus(), fd=True, simulated=True), clock)
        self._drives = []
        for each in description["drives"]:
            ranges = Ranges(*each["ranges"])
            drive = Drive(
                each["name"], each["id"], each["reply_id"], ranges, self._transport, clock, each["scale"], each["zero"]
            )
            drive.adopt(ranges, each["fold"])
            self._drives.append(drive)
        self._joints = self._drives[: description["joints"]]

    def accept(self, arbitration_id: int, data: bytes, stamp_ns: int) -> None:
        """Take a frame that the host had received."""
        if len(data) == 8:
            route = self._transport.routes.get(route_key(arbitration_id, data[0]))
            if route is not None:
                route(bytearray(data), stamp_ns)

    def state(self) -> tuple[Vector, Vector, Vector]:
        """Return position, velocity and effort of the joints, (n,) each."""
        joints = self._joints
        return (
            np.array([drive.position for drive in joints]),
            np.array([drive.velocity for drive in joints]),
            np.array([drive.effort for drive in joints]),
        )


class NoBus(can.BusABC):  # type: ignore[misc]
    """A bus without anybody."""

    def __init__(self) -> None:
        super().__init__("none")
        self._is_shutdown = True

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Lose it."""

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return None, True
