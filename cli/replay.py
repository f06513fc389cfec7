"""`robotctl replay`: what a black box holds, decoded again."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from robotctl.cli.errors import readable_errors
from robotctl.cli.output import write_json
from robotctl.control.frame_replay import compare, export, read_frames
from robotctl.hal.errors import ConfigError


def replay(
    frames: Annotated[Path, typer.Option(help="The file of a stop (...-trip-N.mcap) whose raw frames to decode.")],
    export_: Annotated[
        Path | None, typer.Option("--export", help="Write the frames here: .log as candump does, .asc as Vector's.")
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Write the figures here.")] = None,
) -> None:
    """Decode the raw frames before a stop into states again, and compare them with those that were seen then."""
    console = Console(highlight=False, soft_wrap=True)
    with readable_errors():
        found = compare(frames)
        console.print(
            f"{found.frames} frames ({found.sent} sent) of {found.span_s:.1f} s; {found.ticks} ticks decoded, "
            f"{found.compared} compared with those recorded"
        )
        if found.different:
            console.print(f"[yellow]{found.different} differ[/]: measurements that the supervisor did not believe")
        if export_ is not None:
            console.print(f"{export(read_frames(frames), export_)} frames in {export_}", markup=False)
        if json is not None:
            write_json(json, found._asdict())
        if not found.ticks:
            raise ConfigError(f"{frames}: no tick is marked in its frames", "was the arm on a CAN bus?")
