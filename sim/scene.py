"""What stands around an arm in the twin: a door to be shut, a block to be carried.

Their contacts are with the tool alone: a small ball at the tool point, or pads on the fingers. So the arm itself moves
as it does without a scene. Positions are in the base frame.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import mujoco

from robotctl.hal.profile import Point

_TOUCHES = 2
"""Bit of MuJoCo's contact masks that a scene and the tool share."""
TOOL_RADIUS = 0.02
"""Of the ball at the tool point, m."""
PAD = (0.01, 0.004, 0.01)
"""Half of the sides of a finger's pad, m."""


class Scene(ABC):
    """Something that is added to the model of a robot before that is compiled."""

    @abstractmethod
    def add(self, spec: mujoco.MjSpec) -> None:
        """Add it. The tool point is the site `robotctl_tool`."""


@dataclass(frozen=True, slots=True)
class Door(Scene):
    """An upright panel on a hinge, which runs along z. Shut, it reaches from the hinge along +y; it opens towards -x.

    Its joint is called `door`: 0 when shut, rad.
    """

    hinge: Point
    """The middle of the hinge, m."""
    width: float = 0.4
    height: float = 0.4
    opening: float = 0.5
    """Angle at the start, rad."""
    friction: float = 0.5
    """Nm, as of a hinge that does not swing by itself."""

    def add(self, spec: mujoco.MjSpec) -> None:
        half = 0.5 * self.opening
        body = spec.worldbody.add_body(name="door", pos=self.hinge, quat=[math.cos(half), 0.0, 0.0, math.sin(half)])
        body.add_joint(
            name="door",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=[0.0, 0.0, 1.0],
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            range=[0.0, 1.5],
            ref=self.opening,
            damping=0.5,
            frictionloss=self.friction,
        )
        _touchable(
            body,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[0.0, 0.5 * self.width, 0.0],
            size=[0.01, 0.5 * self.width, 0.5 * self.height],
            mass=2.0,
        )
        ball = spec.site("robotctl_tool")
        _touchable(ball.parent, type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=ball.pos, size=[TOOL_RADIUS, 0.0, 0.0], mass=0.0)


@dataclass(frozen=True, slots=True)
class Block(Scene):
    """A cube that lies on a table and can be gripped; its free joint is called `block`."""

    at: Point
    """The middle of its lower face, on the table, m."""
    pads: Mapping[str, Point]
    """Where the middle of a finger's pad lies in the frame of its body, m, by the body's name."""
    side: float = 0.04
    mass: float = 0.1

    def add(self, spec: mujoco.MjSpec) -> None:
        x, y, z = self.at
        table = spec.worldbody.add_body(name="table", pos=[x, y, z - 0.01])
        _touchable(table, type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.3, 0.3, 0.01])
        body = spec.worldbody.add_body(name="block", pos=[x, y, z + 0.5 * self.side])
        body.add_freejoint(name="block")
        _touchable(body, type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.5 * self.side] * 3, mass=self.mass)
        for finger, middle in self.pads.items():
            _touchable(spec.body(finger), type=mujoco.mjtGeom.mjGEOM_BOX, pos=middle, size=PAD, mass=0.0)


def _touchable(body: mujoco.MjsBody, **about: object) -> None:
    body.add_geom(contype=_TOUCHES, conaffinity=_TOUCHES, friction=[1.0, 0.01, 0.001], **about)
