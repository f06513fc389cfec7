"""P20, proximity: no link may come too close to another one, or to a keep-out.

The geometry stands behind a protocol. It tells the clearance d(q) of each pair, and how fast that can change with
each joint at most; so one measurement serves until the pose has moved by what was to spare:

    d(q) >= d(q0) - reach |q - q0|

Only then is the pair measured again (conservative advancement). As all that is asked is whether a pair has enough
clearance, the answers are those of measuring everything every time.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector
from robotctl.safety.region import Row
from robotctl.safety.trip import Category, Protection, Trip

_ROUNDING = 2e-5
"""By how much two measurements of one clearance may differ, m."""
_BETWEEN = 1e-3
"""By how much clearance may fall short between two poses that are looked at, m."""


class Scene(Protocol):
    """What has to be known of the geometry: m pairs of things that are to stay apart."""

    @property
    def pairs(self) -> Sequence[tuple[str, str]]:
        """Names of the two sides of each pair."""
        ...

    @property
    def reach(self) -> Vector:
        """A bound on how fast each clearance changes with each joint (m, n), m/rad."""
        ...

    def measure(self, position: Vector, pairs: Sequence[int]) -> Vector:
        """Return the clearance of some pairs at joint positions (n,), m; negative where they overlap."""
        ...

    def approach(self, position: Vector, pairs: Sequence[int]) -> Sequence[Vector]:
        """Return for some pairs how fast their clearance shrinks with each joint (n,), m/rad."""
        ...


class NothingNear:
    """A scene without pairs, for an arm whose geometry is not known."""

    def __init__(self, dof: int) -> None:
        self.pairs = ()
        self.reach = np.zeros((0, dof))

    def measure(self, position: Vector, pairs: Sequence[int]) -> Vector:
        return np.zeros(0)

    def approach(self, position: Vector, pairs: Sequence[int]) -> Sequence[Vector]:
        return ()


class Clearances:
    """Lower bounds on the clearances at some poses that move little from one question to the next."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._fade = scene.reach.T.copy()
        # As long as nothing was measured, nothing is known.
        self._poses = np.zeros((1, len(self._fade)))
        self._bounds = np.full((1, len(scene.pairs)), -np.inf)

    def at(self, poses: Vector, enough: float | Vector) -> Vector:
        """Return a bound for every pose (k, n) and pair (k, m), m; those below `enough` are measurements.

        The poses are to be as many as the time before.
        """
        bounds = self._bounds - np.abs(poses - self._poses) @ self._fade
        used_up = ~(bounds >= enough)  # in this direction, so that NaN is measured, too
        if used_up.any():
            for index, pose in enumerate(poses):
                pairs = np.flatnonzero(used_up[index]).tolist()
                if pairs:
                    bounds[index, pairs] = self._scene.measure(pose, pairs)
        self._poses, self._bounds = np.array(poses), bounds
        return bounds


class ProximityLimit:
    """What the shaper keeps: slow where pairs are near, and enough clearance until the arm has stopped."""

    def __init__(self, robot: Robot, scene: Scene) -> None:
        safety = robot.profile.safety
        self._stop = safety.proximity_stop + safety.proximity_margin
        self._slow = safety.proximity_slow
        self._gain = safety.sphere_gain
        self._scene = scene
        self._fade = scene.reach.T.copy()
        self._here = Clearances(scene)
        self._ahead = Clearances(scene)

    def look(self, position: Vector) -> tuple[list[Row], Vector]:
        """Return the rows of the pairs that are near, and what clearance each pair has to keep from here on (m,), m.

        A pair that is too near already may get no nearer.
        """
        clearances = self._here.at(position[np.newaxis], self._slow)[0]
        return self._rows(position, clearances), np.minimum(clearances, self._stop) - _ROUNDING

    def rows(self, poses: Vector) -> list[list[Row]]:
        """Return the rows of the pairs that are near, at each of some poses (k, n) ahead."""
        clearances = self._ahead.at(poses, self._slow)
        return [self._rows(pose, clearance) for pose, clearance in zip(poses, clearances, strict=True)]

    def _rows(self, position: Vector, clearances: Vector) -> list[Row]:
        near = np.flatnonzero(clearances < self._slow).tolist()
        slopes = self._scene.approach(position, near) if near else ()
        return [Row.keeping(clearances[near[i]] - self._stop, self._gain, slope) for i, slope in enumerate(slopes)]

    def clear(self, position: Vector, way: Vector, required: Vector) -> bool:
        """Return whether no way that moves no joint further than `way` (n,) can take a pair its required clearance."""
        enough = required + way @ self._fade
        return bool((self._here.at(position[np.newaxis], enough)[0] >= enough).all())

    def keeps(self, path: Vector, required: Vector) -> bool:
        """Return whether every pair keeps its required clearance (m,) all along a path (k, n).

        Between two poses a pair has at least the mean of its clearances there less half of what it can move by.
        """
        travel = np.abs(np.diff(path, axis=0)) @ self._fade
        between = required - _BETWEEN
        clearances = self._ahead.at(path, np.maximum(required, between + 0.5 * travel.max(axis=0)))
        means = 0.5 * (clearances[1:] + clearances[:-1] - travel)
        return bool((clearances >= required).all() and (means >= between).all())


class ProximityBreach:
    """P20: a measured clearance is below the profile's `proximity_stop`."""

    def __init__(self, robot: Robot, scene: Scene) -> None:
        self._stop = robot.profile.safety.proximity_stop
        self._pairs = scene.pairs
        self._clearances = Clearances(scene)

    def check(self, position: Vector, stamp_ns: int) -> Trip | None:
        """Judge measured joint positions (n,)."""
        clearances = self._clearances.at(position[np.newaxis], self._stop)[0]
        if (clearances >= self._stop).all():  # in this direction, so that NaN trips, too
            return None
        closest = int(clearances.argmin())
        one, other = self._pairs[closest]
        apart = f"{one} and {other} measured {1e3 * clearances[closest]:.1f} mm apart"
        return Trip(Protection.PROXIMITY, Category.BRAKE_HOLD, f"{apart}; acknowledge, then retreat", stamp_ns)
