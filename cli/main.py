"""The `robotctl` command."""

import typer

from robotctl.cli.bench import bench_app
from robotctl.cli.doctor import doctor
from robotctl.cli.emulate import emulate
from robotctl.cli.faults import faults
from robotctl.cli.monitor import monitor
from robotctl.cli.motor import motor_app
from robotctl.cli.replay import replay
from robotctl.cli.run import run
from robotctl.cli.scan import scan
from robotctl.cli.stop import stop

app = typer.Typer(
    help="Run robot arms, on the MuJoCo twin or over CAN, with safety built in.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for verb in (run, stop, scan, doctor, monitor, replay, emulate, faults):
    app.command()(verb)
app.add_typer(bench_app, name="bench")
app.add_typer(motor_app, name="motor")


def main() -> None:
    """Entry point of the console script."""
    app()


if __name__ == "__main__":
    main()
