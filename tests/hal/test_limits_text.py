"""P25: whatever is wrong with a profile is refused, and whatever limits the arm shows in its text and its hash."""

import copy
import io
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from robotctl.hal.errors import ConfigError
from robotctl.hal.limits_text import difference, digest, limits_text
from robotctl.hal.profile import RobotProfile
from robotctl.hal.robot import Robot, load_robot

KEEP_OUTS = (
    "keep_out=[{kind: plane, name: floor, point: [0, 0, 0], normal: [0, 0, 1]},"
    " {kind: box, name: post, centre: [0.8, 0.8, 0], half: [0.1, 0.1, 0.1]}]"
)
FULL = load_robot("panda", [KEEP_OUTS, "home_via=[[0.0, -0.4, 0.0, -2.2, 0.0, 1.9, 0.785]]"])
DATA: dict[str, Any] = FULL.profile.model_dump(mode="json")
"""Every key there is, with all its defaults written out."""


def leaves(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    if isinstance(value, dict):
        return [leaf for key, item in value.items() for leaf in leaves(item, (*path, key))]
    if isinstance(value, list) and value:
        return [leaf for index, item in enumerate(value) for leaf in leaves(item, (*path, index))]
    return [path]


def mappings(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    found = [path] if isinstance(value, dict) else []
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return found + [place for key, item in items for place in mappings(item, (*path, key))]


def at(data: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        data = data[key]
    return data


def changed(path: tuple[Any, ...], value: Any) -> dict[str, Any]:
    data = copy.deepcopy(DATA)
    at(data, path[:-1])[path[-1]] = value
    return data


def written(folder: Path, data: dict[str, Any]) -> Path:
    text = io.StringIO()
    YAML().dump(data, text)
    path = folder / "robot.yaml"
    path.write_text(text.getvalue())
    return path


LEAVES = leaves(DATA)
JOINT_LIMITS = [
    ("joints", index, key, *more)
    for index in range(len(DATA["joints"]))
    for key, *more in (("position", 0), ("position", 1), ("velocity",), ("torque",))
]
examples = settings(max_examples=60, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))


def test_the_full_profile_is_a_good_one(tmp_path: Path) -> None:
    again = load_robot(str(written(tmp_path, DATA)))
    assert again.profile == FULL.profile
    assert again.limits_hash == FULL.limits_hash
    assert len(LEAVES) > 200


@examples
@given(path=st.sampled_from(LEAVES), bad=st.sampled_from([float("nan"), float("inf"), {"a": 1}, [[1]]]))
def test_what_is_no_number_or_of_another_type_is_refused_with_its_line(tmp_path: Path, path, bad) -> None:
    file = written(tmp_path, changed(path, bad))
    with pytest.raises(ConfigError) as caught:
        load_robot(str(file))
    first = caught.value.what.splitlines()[0]
    line = re.match(rf"{re.escape(str(file))}:(\d+): (\S+): ", first)
    assert line, first
    text = file.read_text().splitlines()[int(line[1]) - 1]
    key = next(part for part in reversed(path) if isinstance(part, str))
    assert key in text or text.lstrip().startswith("-"), text


@examples
@given(path=st.sampled_from(mappings(DATA)))
def test_an_unknown_key_is_refused_anywhere(tmp_path: Path, path) -> None:
    file = written(tmp_path, changed((*path, "surprise"), 1.0))
    with pytest.raises(ConfigError, match=rf"{re.escape(str(file))}:\d+: \S*surprise: unknown key"):
        load_robot(str(file))


@examples
@given(path=st.sampled_from(JOINT_LIMITS), factor=st.floats(1.3, 100.0))
def test_a_limit_wider_than_the_models_is_refused(tmp_path: Path, path, factor: float) -> None:
    value = at(DATA, path)
    model = FULL.description.limits[DATA["joints"][path[1]]["name"]]
    if path[2] == "position":
        wider = (model.upper if path[3] else model.lower) + (1.0 if path[3] else -1.0) * factor
    else:
        wider = max(value, model.velocity if path[2] == "velocity" else model.effort) * factor
    file = written(tmp_path, changed(path, wider))
    with pytest.raises(ConfigError, match=re.escape(str(file))):
        load_robot(str(file))


@pytest.mark.parametrize("joint", range(7))
def test_inverted_limits_are_refused(tmp_path: Path, joint: int) -> None:
    lower, upper = DATA["joints"][joint]["position"]
    file = written(tmp_path, changed(("joints", joint, "position"), [upper, lower]))
    with pytest.raises(ConfigError, match=rf"{re.escape(str(file))}:\d+: joints.{joint}: .*not below the upper"):
        load_robot(str(file))


@pytest.mark.parametrize("key", ["velocity", "acceleration", "jerk", "torque", "torque_rate"])
@pytest.mark.parametrize("sign", [0, -1])
def test_a_limit_that_is_zero_or_negative_is_refused(tmp_path: Path, key: str, sign: int) -> None:
    path = ("joints", 3, key)
    with pytest.raises(ConfigError, match=r"robot.yaml:\d+: joints"):
        load_robot(str(written(tmp_path, changed(path, sign * at(DATA, path)))))


@pytest.mark.parametrize("path", LEAVES, ids=lambda path: ".".join(map(str, path)))
def test_every_change_is_refused_or_changes_the_hash(tmp_path: Path, path) -> None:
    value = at(DATA, path)
    match value:
        case bool():
            other: Any = not value
        case int():
            other = value + 1
        case float():
            other = 0.7 * value + 1e-3
        case str():
            other = {"qp": "projection", "disable": "damp"}.get(value, value + "x")
        case _:
            other = None if value is not None else [0.0] * 7
    try:
        profile = RobotProfile.model_validate(changed(path, other))
    except ValueError:
        return
    text = limits_text(profile, FULL.description)
    if path[0] in ("title", "servo_hz", "can", "twin", "model"):
        assert text == FULL.limits_text
    else:
        assert digest(text) != FULL.limits_hash
        assert str(path[0]) in difference(FULL.limits_text, text)


def test_another_model_changes_the_hash() -> None:
    assert digest(limits_text(FULL.profile, load_robot("xarm7").description)) != FULL.limits_hash


def test_a_difference_is_told_line_by_line() -> None:
    before, after = "a: 1\nb: 2\nc: 3", "a: 1\nb: 2.5\nd: 4"
    assert difference(before, after).splitlines() == ["- b: 2", "+ b: 2.5", "- c: 3", "+ d: 4"]
    assert difference(before, before) == ""


def test_the_text_names_joints_and_values(panda: Robot) -> None:
    lines = panda.limits_text.splitlines()
    assert "joints.panda_joint2.velocity: 1.0" in lines
    assert "sphere.radius: 0.42" in lines
    assert "safety.bump: 0.02" in lines
    assert lines == sorted(lines)
    assert load_robot("panda", ["twin.lag_s=0.1", "servo_hz=250"]).limits_hash == panda.limits_hash
    assert load_robot("panda", ["sphere.radius=0.41"]).limits_hash != panda.limits_hash
