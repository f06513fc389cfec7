"""The collision model: hulls that enclose, slopes that are derivatives, and what is a pair."""

from itertools import pairwise
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest

from robotctl.control.collision import CollisionModel, _points, _shapes
from robotctl.control.kinematics import Kinematics, build_model, locked
from robotctl.hal.description import locate
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot, load_robot

MEASURED = 2e-5
"""What GJK may be wrong by, m."""
TABLE = "{kind: plane, name: table, point: [0, 0, -0.1], normal: [0, 0, 2]}"
POST = "{kind: box, name: post, centre: [0.3, 0.5, 0.4], half: [0.1, 0.05, 0.4], rpy: [0.1, 0.2, 0.3]}"


def model_of(robot: Robot) -> CollisionModel:
    return CollisionModel(robot, Kinematics(robot))


@pytest.fixture(scope="module")
def furnished() -> Robot:
    return load_robot("panda", [f"keep_out=[{TABLE}, {POST}]"])


@pytest.fixture
def scene(robot: Robot) -> CollisionModel:
    return model_of(robot)


def poses(robot: Robot, count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(robot.limits.lower, robot.limits.upper, (count, robot.dof))


# -- measuring ------------------------------------------------------------------------------------------------------


def test_hulls_enclose_the_links_with_the_gripper_at_any_opening(robot: Robot, scene: CollisionModel) -> None:
    """Every point of the model's own geometry lies in its link's hull; the fingers bulge between the openings."""
    full = build_model(robot)
    shapes = _shapes(robot, full)
    hulls = {item.name: item.geometry for item in scene._geometry.geometryObjects}
    for opening in np.linspace(0.0, 1.0, 9) if robot.profile.gripper else (0.0,):
        _, placed = pin.buildReducedModel(full, shapes, *locked(robot, full, opening))
        for shape, whole in zip(placed.geometryObjects, shapes.geometryObjects, strict=True):
            hull = hulls[full.frames[whole.parentFrame].name]
            points = _points(shape.geometry)[::7] @ shape.placement.rotation.T + shape.placement.translation
            outside = (points @ np.array(hull.normals()).T + np.array(hull.offsets())).max()
            assert outside < 1e-3


def test_shapes_that_are_no_meshes_are_boxed_in() -> None:
    corners = _points(coal.Cylinder(0.1, 0.4))
    assert len(corners) == 8
    assert np.abs(corners).max(axis=0) == pytest.approx([0.1, 0.1, 0.2])


def test_clearance_changes_no_faster_than_its_reach(robot: Robot, scene: CollisionModel) -> None:
    rng = np.random.default_rng(1)
    for pose in poses(robot, 200):
        step = rng.normal(size=robot.dof) * rng.choice([0.01, 0.3])
        change = np.abs(scene.clearances(pose + step) - scene.clearances(pose))
        assert (change <= scene.reach @ np.abs(step) + MEASURED).all()


def test_the_slope_is_the_derivative_of_the_clearance(robot: Robot, scene: CollisionModel) -> None:
    """Apart and overlapping; at the edges of a hull it jumps, so a few may differ."""
    rng, step = np.random.default_rng(2), 1e-4
    count = wrong = overlapping = 0
    for pose in poses(robot, 100, seed=3):
        way = rng.normal(size=robot.dof)
        way /= np.linalg.norm(way)
        slopes = scene.approach(pose, range(len(scene.pairs))) @ way
        ahead, behind = scene.clearances(pose + step * way), scene.clearances(pose - step * way)
        wrong += int((np.abs((behind - ahead) / (2.0 * step) - slopes) > 0.02).sum())
        overlapping += int((ahead < 0.0).sum())
        count += len(slopes)
    assert wrong <= 0.005 * count
    assert overlapping > 0


def test_a_few_pairs_are_measured_like_all(furnished: Robot) -> None:
    scene = model_of(furnished)
    for pose in poses(furnished, 20):
        every = scene.clearances(pose)
        assert scene.measure(pose, [7, 3]) == pytest.approx(every[[7, 3]], abs=MEASURED)
        assert scene.measure(pose, []).shape == (0,)


def test_a_pose_that_is_no_number_has_no_clearance(panda: Robot) -> None:
    scene, pose = model_of(panda), np.array(panda.profile.home)
    pose[2] = np.nan
    assert not (scene.clearances(pose) > 0.0).any()


def test_keep_outs_are_where_the_profile_says(furnished: Robot) -> None:
    """Against the lowest point of a link, and against the box as coal has it by itself."""
    scene, kinematics = model_of(furnished), Kinematics(furnished)
    items = {item.name: item for item in scene._geometry.geometryObjects}
    data = kinematics.model.createData()
    for pose in poses(furnished, 20):
        pin.forwardKinematics(kinematics.model, data, pose)
        link = items["panda_link6"]
        placement = data.oMi[link.parentJoint]
        points = np.array([placement.act(point) for point in np.array(link.geometry.points())])
        clearances = dict(zip(scene.pairs, scene.clearances(pose), strict=True))
        assert clearances["panda_link6", "table"] == pytest.approx(points[:, 2].min() + 0.1, abs=MEASURED)
        local = (points - [0.3, 0.5, 0.4]) @ pin.rpy.rpyToMatrix(0.1, 0.2, 0.3)
        beyond = np.maximum(np.abs(local) - [0.1, 0.05, 0.4], 0.0)
        assert clearances["panda_link6", "post"] <= np.linalg.norm(beyond, axis=1).min() + MEASURED


# -- pairs ----------------------------------------------------------------------------------------------------------


def test_neighbours_are_no_pair_and_keep_outs_pair_with_all_that_moves(furnished: Robot) -> None:
    pairs = model_of(furnished).pairs
    links = [f"panda_link{index}" for index in range(8)]
    assert not set(pairs) & set(pairwise(links))
    moving = {*links[1:], "panda_hand", "panda_leftfinger", "panda_rightfinger"}
    for name in ("table", "post"):
        assert {one for one, other in pairs if other == name} == moving
    assert ("panda_link0", "panda_hand") in pairs


def test_ignored_pairs_cannot_meet_or_are_always_near(robot: Robot, scene: CollisionModel) -> None:
    everything = model_of(load_robot(robot.profile.name, ["collision.ignore=[]"]))
    ignored = [index for index, pair in enumerate(everything.pairs) if pair not in scene.pairs]
    assert len(ignored) == len(robot.profile.collision.ignore)
    # By the vendor: Panda's fifth link has a hull much fatter than the link.
    ignored = [index for index in ignored if everything.pairs[index] != ("panda_link5", "panda_hand")]
    clearances = np.array([everything.measure(pose, ignored) for pose in poses(robot, 2000, seed=5)])
    assert ((clearances.min(axis=0) > 0.03) | (clearances.max(axis=0) < 0.05)).all()


def test_home_and_rest_are_clear(robot: Robot, scene: CollisionModel) -> None:
    for pose in (robot.profile.home, robot.profile.rest):
        assert scene.clearances(np.array(pose)).min() > robot.profile.safety.proximity_slow


# -- what is refused ------------------------------------------------------------------------------------------------


def test_an_unknown_name_to_ignore_is_refused() -> None:
    robot = load_robot("panda", ["collision.ignore=[[panda_link0, panda_elbow]]"])
    with pytest.raises(ConfigError, match=r"there is no \['panda_elbow'\]\n  try: known are panda_link0, .*panda_hand"):
        model_of(robot)


def copy_of(tmp_path: Path, old: str, new: str) -> Robot:
    """Panda from a URDF of its own."""
    text = locate("example-robot-data", "panda_description/urdf/panda.urdf").read_text()
    assert old in text
    (tmp_path / "panda.urdf").write_text(text.replace(old, new))
    return load_robot("panda", ["model.package=''", f"model.file={tmp_path / 'panda.urdf'}"])


def test_missing_meshes_are_named(tmp_path: Path) -> None:
    robot = copy_of(tmp_path, "/collision/link3.stl", "/collision/lost.stl")
    with pytest.raises(ConfigError, match=r"panda.urdf: .*\n  try: install the meshes, or set collision: null"):
        model_of(robot)


def test_a_model_without_geometry_is_refused_unless_told_so(tmp_path: Path) -> None:
    robot = copy_of(tmp_path, "collision>", "ignored>")
    with pytest.raises(ConfigError, match="the model has no collision geometry"):
        model_of(robot)
