"""YAML 1.2 files that are checked against a model, with errors that name file, line and key."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import MarkedYAMLError

from robotctl.hal.errors import ConfigError

M = TypeVar("M", bound=BaseModel)

_WORDING = {
    "extra_forbidden": "unknown key",
    "missing": "missing",
    "finite_number": "must be a finite number",
}


def read_document(path: Path, model: type[M], overrides: Sequence[str] = ()) -> M:
    """Return the file at `path` as a validated `model`.

    Args:
        overrides: `dotted.key=value` settings that replace or add to what the file says; values are YAML,
            and list items are addressed by their index.

    Raises:
        ConfigError: with one line per problem: file, line, key, what is wrong.
    """
    yaml = YAML(typ="rt")
    try:
        data = yaml.load(path)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}", "check the path") from None
    except MarkedYAMLError as error:
        mark = error.problem_mark
        line = mark.line + 1 if mark else 1
        raise ConfigError(f"{path}:{line}: not valid YAML: {error.problem}", "check indentation and quotes") from None
    if not isinstance(data, CommentedMap):
        raise ConfigError(f"{path}:1: a mapping of keys to values is expected")
    for override in overrides:
        _apply(data, override)
    try:
        return model.model_validate(data)
    except ValidationError as error:
        problems = []
        for problem in error.errors():
            loc = _without_tags(data, problem["loc"])
            what = _WORDING.get(problem["type"], problem["msg"].removeprefix("Value error, "))
            if problem["type"] == "union_tag_invalid":
                loc.append(problem["ctx"]["discriminator"].strip("'_()"))
                what = f"must be one of {problem['ctx']['expected_tags']}"
            key = ".".join(str(part) for part in loc)
            problems.append(f"{path}:{line_of(data, loc)}: {f'{key}: ' if key else ''}{what}")
        raise ConfigError("\n".join(problems), "correct the file; robotctl starts nothing until it is clean") from None


def _without_tags(data: Any, loc: Sequence[str | int]) -> list[str | int]:
    """Return a location without the names that pydantic puts in for the kinds of a union: no key of the document."""
    kept: list[str | int] = []
    for number, part in enumerate(loc, 1):
        if isinstance(data, CommentedMap) and part not in data and number < len(loc):
            continue
        kept.append(part)
        try:
            data = data[part]
        except (KeyError, IndexError, TypeError):
            data = None
    return kept


def line_of(data: Any, loc: Sequence[str | int]) -> int:
    """Return the line (from 1) of the innermost part of `loc` that the document has."""
    line = 1
    for part in loc:
        if not isinstance(data, CommentedMap | CommentedSeq):
            break
        try:
            line = (data.lc.key(part) if isinstance(data, CommentedMap) else data.lc.item(part))[0] + 1
            data = data[part]
        except (KeyError, IndexError, TypeError):
            break
    return line


def _apply(data: Any, override: str) -> None:
    key, separator, text = override.partition("=")
    parts = key.strip().split(".")
    if not separator or not all(parts):
        raise ConfigError(f"setting {override!r} is not of the form key=value", "for example safety.sphere=projection")
    for index, part in enumerate(parts[:-1]):
        try:
            data = data[int(part)] if isinstance(data, list) else data.setdefault(part, CommentedMap())
        except (ValueError, IndexError, AttributeError):
            raise ConfigError(f"setting {override!r}: {'.'.join(parts[: index + 1])} does not exist") from None
    value = YAML(typ="safe").load(text)
    try:
        data[int(parts[-1]) if isinstance(data, list) else parts[-1]] = value
    except (ValueError, IndexError, TypeError):
        raise ConfigError(f"setting {override!r}: {key} does not exist") from None
