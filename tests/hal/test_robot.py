"""Profiles: what loads, and what is refused, with file, line and remedy."""

from pathlib import Path

import pytest

from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot, load_robot, profile_path, robot_names


def edited(tmp_path: Path, old: str, new: str, name: str = "panda") -> Path:
    text = profile_path(name).read_text()
    assert old in text
    path = tmp_path / f"{name}.yaml"
    path.write_text(text.replace(old, new, 1))
    return path


def test_five_robots_are_shipped() -> None:
    assert robot_names() == ["kinova", "openarm", "openarm_bimanual", "panda", "xarm7"]


def test_home_and_rest_lie_inside_the_sphere(robot: Robot) -> None:
    import numpy as np

    from robotctl.control.kinematics import Kinematics

    kinematics = Kinematics(robot)
    centre = np.array(robot.profile.sphere.centre)
    for pose in (robot.profile.home, robot.profile.rest):
        assert np.linalg.norm(kinematics.tool(np.array(pose)) - centre) < robot.profile.sphere.radius - 0.02


def test_limits_lie_inside_the_models(robot: Robot) -> None:
    for joint in robot.profile.joints:
        model = robot.description.limits[joint.name]
        assert joint.position[0] >= model.lower + 0.09
        assert joint.position[1] <= model.upper - 0.09


def test_arrays_are_read_only(panda: Robot) -> None:
    with pytest.raises(ValueError, match="read-only"):
        panda.limits.velocity[0] = 99.0


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("brakes: true", "brakes: true\nbreaks: true", r"panda.yaml:\d+: breaks: unknown key"),
        ("servo_hz: 500", "servo_hz: 5000", r"servo_hz: .*less than or equal to 1000"),
        ("velocity: 1.0", "velocity: .nan", r"joints.0.velocity: .*finite"),
        ("velocity: 1.0", "velocity: .inf", r"joints.0.velocity: .*finite"),
        ("velocity: 1.0", "velocity: fast", r"joints.0.velocity"),
        ("velocity: 1.0", "velocity: true", r"joints.0.velocity"),
        ("velocity: 1.0", "velocity: '1.0'", r"joints.0.velocity"),
        ("id: 1,", "id: true,", r"joints.0.drive.id"),
        ("velocity: 1.0", "velocity: 2.5", r"velocity 2.5 exceeds the model's 2.175"),
        ("torque: 87.0", "torque: 88.0", r"torque 88.0 exceeds the model's 87"),
        ("[-2.797, 2.797]", "[-3.1, 2.797]", r"wider than the model's"),
        ("[-2.797, 2.797]", "[2.797, -2.797]", r"not below the upper"),
        ("motor: DM6248P", "motor: DM9999", r"unknown motor 'DM9999'"),
        ("id: 2,", "id: 1,", r"used by more than one motor"),
        ("name: panda_joint1", "name: panda_elbow", r"'panda_elbow' is not in the model"),
        ("home: [0.0,", "home: [9.0,", r"outside its limits"),
        ("home: [0.0, -0.4,", "home: [0.0,", r"6 values for 7 joints"),
        ("brakes: true", "home_via: [[0.0, 0.1], [0.0]]\nbrakes: true", r"home_via.0: 2 values for 7 joints"),
        ("brakes: true", "twin: {start: [0.0]}\nbrakes: true", r"twin.start: 1 values for 7 joints"),
        ("brakes: true", "start_spread: -0.1\nbrakes: true", r"panda.yaml:\d+: start_spread"),
        (
            "brakes: true",
            "brakes: true\nkeep_out: [{kind: plane, name: a, point: [0, 0, 0], normal: [0, 0, 0]}]",
            r"keep_out.0.plane: normal: has no direction",
        ),
        (
            "brakes: true",
            "brakes: true\nkeep_out: [{kind: box, name: a, centre: [0, 0, 0], half: [1, 0, 1]}]",
            r"keep_out.0.half.1: .*greater than 0",
        ),
        (
            "brakes: true",
            "brakes: true\nkeep_out: [{kind: plane, name: sphere, point: [0, 0, 0], normal: [0, 0, 1]}]",
            r"keep_out: more than one region is called \['sphere'\]",
        ),
        (
            "brakes: true",
            "brakes: true\nkeep_out: [{kind: cone, name: a}]",
            r"keep_out.0.kind: must be one of 'plane', 'box'",
        ),
        ("title:", "title", r"panda.yaml:\d+: not valid YAML"),
        ("title: Franka Emika Panda (7 joints; CAN drives emulated only)\n", "", r"title: missing"),
    ],
)
def test_a_bad_profile_is_refused(tmp_path: Path, old: str, new: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        load_robot(str(edited(tmp_path, old, new)))


def test_the_line_of_a_bad_key_is_named(tmp_path: Path) -> None:
    path = edited(tmp_path, "brakes: true", "breaks: true")
    line = next(n for n, text in enumerate(path.read_text().splitlines(), 1) if text.startswith("breaks"))
    with pytest.raises(ConfigError, match=f"panda.yaml:{line}: breaks: unknown key"):
        load_robot(str(path))


def test_an_unknown_robot_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="kinova, openarm, openarm_bimanual, panda, xarm7"):
        load_robot("pander")
    with pytest.raises(ConfigError, match="No such file"):
        load_robot("nowhere/robot.yaml")


def test_overrides_are_validated_like_the_file() -> None:
    assert load_robot("panda", ["safety.sphere=projection"]).profile.safety.sphere == "projection"
    assert load_robot("panda", ["joints.0.velocity=0.5"]).limits.velocity[0] == 0.5
    for bad in ("safety.sphere=cube", "nonsense", "twin.lag=0.1", "joints.9.velocity=1", "joints.0.velocity=9"):
        with pytest.raises(ConfigError):
            load_robot("panda", [bad])


def test_the_stopping_time_is_published(robot: Robot) -> None:
    assert 0.05 < robot.stopping_time_s < 0.5


def test_more_than_the_payload_cannot_be_missing() -> None:
    load_robot("panda", ["payload=1.0", "twin.payload=-1.0"])
    with pytest.raises(ConfigError, match=r"twin.payload: -1.1 kg takes away more than the payload of 1.0 kg"):
        load_robot("panda", ["payload=1.0", "twin.payload=-1.1"])
