"""A person's word before something is written that stays."""

import sys

from rich.console import Console

from robotctl.hal.errors import ConfigError


def confirm(console: Console, what: str, word: str, yes: bool) -> None:
    """Return once somebody has typed `word`, or at once with `yes`.

    Raises:
        ConfigError: if something else was typed, or there is no terminal to type at.
    """
    console.print(what, markup=False)
    if yes:
        return
    if not sys.stdin.isatty():
        raise ConfigError("this is to be confirmed by a person at a terminal", "in a script, say --yes")
    console.print(f"type {word} to go on: ", end="", markup=False)
    if sys.stdin.readline().strip() != word:
        raise ConfigError("not confirmed; nothing was written")
