"""What limits an arm, as text: one `key: value` per line, so that two versions can be told apart line by line (P25).

Everything in a profile counts, with the description of the model, but for what is listed here. So a key that is added
to the profile some day counts without anybody having thought of it.
"""

import json
from collections.abc import Iterator
from hashlib import sha256
from typing import Any

from robotctl.hal.description import Description
from robotctl.hal.profile import RobotProfile

_UNLIMITING = {"title", "servo_hz", "can", "twin", "model"}
"""A title, rates and wiring that bring-up verifies, the twin's imperfections, and where the model's file lies."""


def limits_text(profile: RobotProfile, description: Description) -> str:
    """Return the text of a profile and its model: sorted lines, values as JSON."""
    values = profile.model_dump(mode="json", exclude=_UNLIMITING)
    values["model"] = sha256(description.xml.encode()).hexdigest()
    return "\n".join(sorted(f"{key}: {json.dumps(value)}" for key, value in _leaves("", values)))


def digest(text: str) -> str:
    """Return the hash that stands for a text."""
    return sha256(text.encode()).hexdigest()


def difference(before: str, after: str) -> str:
    """Return what became of a text: lines that went, with a minus, and lines that came, with a plus."""
    old, new = set(before.splitlines()), set(after.splitlines())
    lines = [f"- {line}" for line in old - new] + [f"+ {line}" for line in new - old]
    return "\n".join(sorted(lines, key=lambda line: (line[2:].partition(":")[0], line[0] == "+")))


def _leaves(key: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for name, item in value.items():
            yield from _leaves(f"{key}.{name}" if key else name, item)
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for index, item in enumerate(value):
            yield from _leaves(f"{key}.{item.get('name', index)}", item)
    else:
        yield key, value
