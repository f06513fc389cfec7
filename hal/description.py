"""One description of a robot for both engines: the URDF or MJCF text that Pinocchio and MuJoCo are fed alike.

The file named by a profile is read once and normalised: geometry and everything an engine might merge or
reinterpret goes, joints, inertias and frames stay. Two traps are closed here for good:

* a `continuous` joint is two coordinates in Pinocchio and one in MuJoCo, so it becomes `revolute`;
* Pinocchio keeps only the first body of an MJCF world and drops the others without a word, so an MJCF has to name
  the bodies that are meant, and they become one.
"""

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

from robotctl.hal.errors import ConfigError

_FULL_TURN = 2.0 * math.pi


@dataclass(frozen=True, slots=True)
class ModelLimits:
    """What the model's own file allows one joint. None where the file is silent."""

    lower: float
    """rad or m"""
    upper: float
    velocity: float | None
    """rad/s or m/s"""
    effort: float | None
    """Nm or N"""


@dataclass(frozen=True, slots=True)
class Description:
    """A normalised robot description.

    `xml` holds the text, `format` its language, `limits` the model's limits by joint name.
    """

    xml: str
    format: Literal["urdf", "mjcf"]
    limits: dict[str, ModelLimits]


def locate(package: str, file: str) -> Path:
    """Return the path of a data file that an installed distribution ships.

    Args:
        package: name of the distribution, or "" for a path of the user's own.
        file: the path, or the end of it inside the distribution.

    Raises:
        ConfigError: if the distribution or the file is missing, or the end fits several files.
    """
    if not package:
        path = Path(file).expanduser()
        if not path.is_file():
            raise ConfigError(f"model file {path} does not exist", "check the profile's model.file")
        return path
    try:
        files = metadata.files(package) or []
    except metadata.PackageNotFoundError:
        raise ConfigError(f"model package {package!r} is not installed", f"pip install {package}") from None
    found = [entry for entry in files if str(entry).endswith("/" + file)]
    if len(found) != 1:
        raise ConfigError(f"{len(found)} files of package {package!r} end in {file!r}", "give a longer model.file")
    return Path(str(found[0].locate())).resolve()


def load_description(path: Path, root: str | list[str] | None = None, *, collision: bool = False) -> Description:
    """Read and normalise a URDF, or the body `root` of an MJCF, or several.

    Args:
        collision: keep the geometry that a collision check needs; meshes are named so that they are found.

    Raises:
        ConfigError: if the file is not well-formed, is neither language, or lacks a body.
    """
    try:
        tree = ET.parse(path).getroot()  # noqa: S314 - the user's own model file
    except ET.ParseError as error:
        raise ConfigError(f"{path}: not well-formed XML: {error}") from None
    if tree.tag == "robot":
        return _urdf(tree, collision)
    if tree.tag == "mujoco":
        return _mjcf(tree, path, [root] if isinstance(root, str) else root or [], collision)
    raise ConfigError(f"{path}: <{tree.tag}> is neither a URDF nor an MJCF")


def _urdf(robot: ET.Element, collision: bool) -> Description:
    for tag in ("transmission", "gazebo", "mujoco", "material"):
        for element in robot.findall(tag):
            robot.remove(element)
    for link in robot.findall("link"):
        for tag in ("visual",) if collision else ("visual", "collision"):
            for element in link.findall(tag):
                link.remove(element)
    limits = {}
    for joint in robot.findall("joint"):
        if joint.get("type") == "continuous":
            joint.set("type", "revolute")
        limit = joint.find("limit")
        if joint.get("type") in ("revolute", "prismatic") and limit is not None:
            limits[joint.get("name", "")] = ModelLimits(
                lower=float(limit.get("lower", -_FULL_TURN)),
                upper=float(limit.get("upper", _FULL_TURN)),
                velocity=float(limit.get("velocity", math.inf)),
                effort=float(limit.get("effort", math.inf)),
            )
    # MuJoCo would merge fixed links into their parents, and the tool frame with them.
    ET.SubElement(ET.SubElement(robot, "mujoco"), "compiler", fusestatic="false")
    return Description(ET.tostring(robot, encoding="unicode"), "urdf", limits)


def _mjcf(model: ET.Element, path: Path, roots: list[str], collision: bool) -> Description:
    world = model.find("worldbody")
    bodies = [] if world is None else world.findall("body")
    names = [body.get("name", "") for body in bodies]
    if world is None or not roots or not set(roots) <= set(names):
        missing = ", ".join(repr(root) for root in roots if root not in names) or None
        raise ConfigError(f"{path}: no body {missing} under worldbody", f"set model.root to one of {', '.join(names)}")
    for element in list(world):
        world.remove(element)
    # Pinocchio puts a body that stands alone under the world at the origin; inside a fixed root it keeps its place.
    ET.SubElement(world, "body", name="robotctl_root").extend(bodies[names.index(root)] for root in roots)
    for tag in ("actuator", "sensor", "equality", "contact", "tendon", "keyframe", "visual", "statistic"):
        for element in model.findall(tag):
            model.remove(element)
    compiler = model.find("compiler")
    if compiler is None or compiler.get("angle", "degree") != "radian":
        raise ConfigError(f"{path}: angles in degrees", 'set <compiler angle="radian"/> and convert the file')
    compiler.set("meshdir", str(path.parent / compiler.get("meshdir", compiler.get("assetdir", ""))))
    unused = {"camera", "light"} if collision else {"camera", "light", "geom", "asset"}
    for parent in list(model.iter()):
        for element in list(parent):
            if element.tag in unused:
                parent.remove(element)
    limits = {}
    for joint in world.iter("joint"):
        lower, upper = (float(part) for part in joint.get("range", f"{-_FULL_TURN} {_FULL_TURN}").split())
        force = joint.get("actuatorfrcrange")
        limits[joint.get("name", "")] = ModelLimits(
            lower, upper, velocity=None, effort=float(force.split()[1]) if force else None
        )
    return Description(ET.tostring(model, encoding="unicode"), "mjcf", limits)
