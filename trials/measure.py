"""What a stop came to, measured on the plant's true state from the records of its ticks."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotctl.hal.robot import Robot
from robotctl.safety.machine import State

_STOPPING = (State.STOPPING, State.HOLD, State.DISABLED, State.FAULT)


@dataclass(frozen=True, slots=True)
class Stop:
    """From the onset of a fault to rest."""

    reaction_s: float
    """From the onset to the first stopping command."""
    standstill_s: float
    """From that command to rest; infinite if the arm never came to rest."""
    joint_way: float
    """Largest distance of a joint from where it was at the onset, rad, until rest."""
    tool_way: float
    """The same of the tool point, m."""
    drift: float
    """Largest way of a joint after rest, rad."""


def measure_stop(records: NDArray[Any], onset_ns: int, robot: Robot) -> Stop | None:
    """Return what a stop came to, or None if there was none.

    Args:
        records: of the ticks from the one before the onset to well after rest, before the operator did anything.
        onset_ns: when the fault began.
    """
    stamps = records["stamp_ns"]
    stopped = np.flatnonzero((stamps >= onset_ns) & np.isin(records["state"], _STOPPING))
    if not len(stopped):
        return None
    first = int(stopped[0])
    # The command leaves at the end of its tick.
    reaction = int(stamps[first]) + int(records["duration_ns"][first]) - onset_ns
    moving = np.abs(records["true_velocity"]).max(axis=1) >= robot.profile.safety.standstill
    late = np.flatnonzero(moving[first:])
    rest = first + (int(late[-1]) + 1 if len(late) else 0)
    at_rest = rest < len(records)
    way = slice(0, min(rest, len(records) - 1) + 1)
    position, tool = records["true_position"], records["true_tool"]
    return Stop(
        reaction * 1e-9,
        int(stamps[rest] - stamps[first]) * 1e-9 if at_rest else np.inf,
        float(np.abs(position[way] - position[0]).max()),
        float(np.linalg.norm(tool[way] - tool[0], axis=1).max()),
        float(np.abs(position[rest:] - position[rest]).max()) if at_rest else np.inf,
    )
