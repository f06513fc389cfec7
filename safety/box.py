"""Where the velocity of each joint may be one step from now: caps, and room to brake before its soft limits."""

import numpy as np

from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector

_RETURN_SHARE = 0.1
"""Share of the velocity cap at which a joint past its edge is led back at most."""


class JointBox:
    """Bounds on the velocity at the end of a step of constant acceleration, q' = q + dt (v + v')/2."""

    def __init__(
        self, robot: Robot, step_s: float, usable: float, *, brake_share: float = 1.0, pull: float = 0.0
    ) -> None:
        """Prepare for steps of `step_s`.

        Args:
            step_s: s.
            usable: share of the velocity and acceleration caps that may be used.
            brake_share: share of that acceleration that braking before a soft limit relies on.
            pull: speed at which a joint past its edge is led back, per distance, 1/s.
        """
        limits = robot.limits
        self.velocity_cap = usable * limits.velocity
        """(n,), rad/s"""
        self.acceleration_cap = usable * limits.acceleration
        """(n,), rad/s^2"""
        self.step = self.acceleration_cap * step_s
        """Largest change of velocity in a step (n,), rad/s."""
        n = self._n = robot.dof
        self._dt = step_s
        # Upper and mirrored lower bounds side by side: one vector operation serves both.
        margin = robot.profile.safety.position_margin
        self._edge = np.concatenate([limits.upper - margin, -(limits.lower + margin)])
        self._brake2 = np.tile(brake_share * self.acceleration_cap, 2)
        self._cap2 = np.tile(self.velocity_cap, 2)
        self._half_step2 = 0.5 * self._brake2 * step_s
        self._pull = pull
        # Where a joint is further from its limit than braking from the cap takes, the limit asks for nothing.
        self._free = self._edge - self._cap2 * (0.5 * step_s + self._cap2 / (2.0 * self._brake2))
        self._mirrored = np.empty(2 * n)
        # A hair wider, so that the limiter's own full acceleration does not count as clipped for a rounding error.
        self._change = self.step * (1.0 + 1e-9)

    def bounds(self, position: Vector, velocity: Vector) -> tuple[Vector, Vector]:
        """Return the least and the largest velocity (n,), rad/s, after a step from `position` and `velocity`."""
        n = self._n
        mirrored = self._mirrored
        np.add(position, (0.5 * self._dt) * velocity, out=mirrored[:n])
        np.negative(mirrored[:n], out=mirrored[n:])
        bound = self._cap2 if (mirrored <= self._free).all() else self._position_bound(mirrored)
        upper, lower = bound[:n], -bound[n:]
        # The acceleration caps come last: a motion that is past a bound is led back as fast as they allow.
        least, most = velocity - self._change, velocity + self._change
        return np.minimum(np.maximum(lower, least), most), np.maximum(np.minimum(upper, most), least)

    def _position_bound(self, mirrored: Vector) -> Vector:
        """Return the speed towards each limit from which braking ends there: v dt/2 + v^2/(2 a) <= room.

        Past the edge it is no further out, and back in at `pull` times the excess.
        """
        room = self._edge - mirrored
        root = np.sqrt(self._half_step2**2 + 2.0 * self._brake2 * np.maximum(room, 0.0)) - self._half_step2
        back = np.maximum(self._pull * np.minimum(room, 0.0), -_RETURN_SHARE * self._cap2)
        return np.minimum(root + back, self._cap2)
