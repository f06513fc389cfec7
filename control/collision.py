"""Collision geometry of an arm: a convex hull per link, the keep-outs, and the pairs of them that are to stay apart.

Hulls are conservative, and fast to measure (GJK, by coal). The fingers' hulls cover them from closed to open. Links
on one joint or on neighbouring joints are no pair; others that touch by construction, or that cannot meet, stand in
the profile as `collision.ignore`.
"""

import tempfile
from collections.abc import Sequence
from itertools import combinations, product
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin

from robotctl.control.kinematics import Kinematics, build_model, locked
from robotctl.hal.description import load_description, locate
from robotctl.hal.errors import ConfigError
from robotctl.hal.profile import KeepOutBox, KeepOutPlane
from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector, frozen
from robotctl.safety.region import rotation

_OPENINGS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Of the gripper, at which its fingers are added to their hulls; between them they bulge by less than a millimetre."""
_BASE = 0
"""Pinocchio's joint of all that does not move."""
_MESHES = coal.CachedMeshLoader()


class CollisionModel:
    """Clearance of every pair at any pose. Holds scratch memory: not for two threads."""

    def __init__(self, robot: Robot, kinematics: Kinematics) -> None:
        """Build hulls and pairs.

        Raises:
            ConfigError: if the model's geometry cannot be read, or the profile ignores what there is not.
        """
        self._model = kinematics.model
        self._data = self._model.createData()
        self._geometry = pin.GeometryModel()
        reaches = []
        for name, joint, points in _links(robot):
            self._add(name, joint, pin.SE3.Identity(), _hull(points))
            reaches.append(_reach(self._model, joint, float(np.linalg.norm(points, axis=1).max())))
        links = len(reaches)
        for item in robot.profile.keep_out:
            self._add(item.name, _BASE, *_obstacle(item))
            reaches.append(np.zeros(robot.dof))
        self._pair_up(links, _ignored(robot, [item.name for item in self._geometry.geometryObjects]))
        self._scratch = self._geometry.createData()
        pairs = [(pair.first, pair.second) for pair in self._geometry.collisionPairs]
        names = [item.name for item in self._geometry.geometryObjects]
        self.pairs = tuple((names[one], names[other]) for one, other in pairs)
        """Names of the two sides of every pair."""
        moved = np.array(reaches)
        one, other = (moved[[pair[side] for pair in pairs]].reshape(-1, robot.dof) for side in (0, 1))
        self._side = (one > 0.0) * 1.0 - (other > 0.0)
        """Which side of a pair a joint moves: 1 the first, -1 the second, 0 both alike or none."""
        self.reach = frozen(np.abs(self._side) * (one + other))
        """How fast each clearance may change with each joint at most (m, n), m/rad."""

    def measure(self, position: Vector, pairs: Sequence[int]) -> Vector:
        """Return the clearance of some pairs, m; negative where they overlap."""
        geometry, scratch = self._geometry, self._scratch
        pin.updateGeometryPlacements(self._model, self._data, geometry, scratch, position)
        return np.array([pin.computeDistance(geometry, scratch, pair).min_distance for pair in pairs])

    def clearances(self, position: Vector) -> Vector:
        """Return the clearance of all pairs (m,), m."""
        return self.measure(position, range(len(self.pairs)))

    def approach(self, position: Vector, pairs: Sequence[int]) -> list[Vector]:
        """Return for some pairs how fast their clearance shrinks with each joint (n,), m/rad.

        With n the unit vector from the first side's nearest point to the second's, p either of them, and J the
        Jacobian of p as a point of one side or the other: n (J_first - J_second).
        """
        geometry, scratch = self._geometry, self._scratch
        jacobian = pin.computeJointJacobians(self._model, self._data, position)
        pin.updateGeometryPlacements(self._model, self._data, geometry, scratch)
        slopes = []
        for pair in pairs:
            nearest = pin.computeDistance(geometry, scratch, pair)
            x, y, z = nearest.getNearestPoint1().tolist()
            a, b, c = nearest.normal.tolist()
            slopes.append(
                np.array([a, b, c, y * c - z * b, z * a - x * c, x * b - y * a]) @ jacobian * self._side[pair]
            )
        return slopes

    def _add(self, name: str, joint: int, placement: pin.SE3, shape: coal.CollisionGeometry) -> None:
        self._geometry.addGeometryObject(pin.GeometryObject(name, joint, placement, shape))

    def _pair_up(self, links: int, ignored: set[frozenset[str]]) -> None:
        parents, objects = self._model.parents, self._geometry.geometryObjects
        for one, other in combinations(range(len(objects)), 2):
            a, b = objects[one].parentJoint, objects[other].parentJoint
            neighbours = other < links and (parents[a] == b or parents[b] == a)
            if a != b and not neighbours and frozenset((objects[one].name, objects[other].name)) not in ignored:
                self._geometry.addCollisionPair(pin.CollisionPair(one, other))


def _ignored(robot: Robot, names: list[str]) -> set[frozenset[str]]:
    pairs = robot.profile.collision.ignore if robot.profile.collision else []
    unknown = sorted({name for pair in pairs for name in pair} - set(names))
    if unknown:
        raise ConfigError(f"{robot.source}: collision.ignore: there is no {unknown}", f"known are {', '.join(names)}")
    return {frozenset(pair) for pair in pairs}


def _reach(model: pin.Model, joint: int, radius: float) -> Vector:
    """Return a bound on the distance between a link's points and the axis of each joint that moves it, m; else 0."""
    reach, far = np.zeros(model.nv), radius
    while joint != _BASE:
        reach[model.idx_vs[joint]] = far
        far += float(np.linalg.norm(model.jointPlacements[joint].translation))
        joint = model.parents[joint]
    return reach


def _hull(points: Vector) -> coal.Convex:
    vectors = coal.StdVec_Vec3s()
    vectors.extend(list(points))
    return coal.Convex.convexHull(vectors, True, "Qt")


def _obstacle(item: KeepOutPlane | KeepOutBox) -> tuple[pin.SE3, coal.CollisionGeometry]:
    if isinstance(item, KeepOutPlane):
        normal = np.array(item.normal) / np.linalg.norm(item.normal)
        return pin.SE3.Identity(), coal.Halfspace(normal, float(normal @ item.point))
    return pin.SE3(rotation(*item.rpy), np.array(item.centre)), coal.Box(*(2.0 * half for half in item.half))


def _links(robot: Robot) -> list[tuple[str, int, Vector]]:
    """Return name, joint and points (k, 3), m, in that joint's frame, of every link that has collision geometry."""
    full = build_model(robot)
    shapes = _shapes(robot, full)
    links: dict[str, tuple[int, list[Vector]]] = {}
    for opening in _OPENINGS:
        _, placed = pin.buildReducedModel(full, shapes, *locked(robot, full, opening))
        for shape, whole in zip(placed.geometryObjects, shapes.geometryObjects, strict=True):
            _, parts = links.setdefault(full.frames[whole.parentFrame].name, (shape.parentJoint, []))
            parts.append(_points(shape.geometry) @ shape.placement.rotation.T + shape.placement.translation)
    if not links:
        raise ConfigError(f"{robot.source}: the model has no collision geometry", "set collision: null to do without")
    return [(name, joint, np.unique(np.concatenate(parts), axis=0)) for name, (joint, parts) in links.items()]


def _shapes(robot: Robot, full: pin.Model) -> pin.GeometryModel:
    source = robot.profile.model
    path = locate(source.package, source.file)
    description = load_description(path, source.root, collision=True)
    try:
        if description.format == "urdf":
            folders = [str(folder) for folder in path.parents]
            return pin.buildGeomFromUrdfString(full, description.xml, pin.COLLISION, None, folders, _MESHES)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "model.xml"
            file.write_text(description.xml)
            return pin.buildGeomFromMJCF(full, str(file), pin.COLLISION)
    except (RuntimeError, ValueError) as error:
        reason = str(error).strip().splitlines()[-1]
        raise ConfigError(f"{path}: {reason}", "install the meshes, or set collision: null") from None


def _points(shape: coal.CollisionGeometry) -> Vector:
    """Return points (k, 3) whose hull encloses a shape: a mesh's own, or the corners of the box around it."""
    if isinstance(shape, coal.BVHModelBase):
        return np.array(shape.vertices())
    shape.computeLocalAABB()
    box = shape.aabb_local
    return np.array(list(product(*zip(box.min_, box.max_, strict=True))))
