"""Faults of the plant and of the drives, planted alike on the twin and on emulated motors."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from robotctl.trials.bench import Bench


@dataclass(frozen=True, slots=True)
class Planted:
    """A fault that is there."""

    undo: Callable[[], None]
    showed: Callable[[], bool]
    """Whether it really did something; asked after the stop."""


Fault = Callable[[Bench], Planted]


def fastest(bench: Bench) -> int:
    """Return the joint that moves fastest, by its cap."""
    return int((np.abs(bench.plant.truth().velocity) / bench.robot.limits.velocity).argmax())


def stuck(bench: Bench) -> Planted:
    """The joint that moves fastest seizes up."""
    axis = fastest(bench)
    plant = bench.plant
    where = plant.truth().position[axis]
    plant.jam(axis, jammed=True)
    return Planted(lambda: plant.jam(axis, jammed=False), lambda: abs(plant.truth().position[axis] - where) < 0.05)
