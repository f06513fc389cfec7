"""`robotctl run`: let a policy work on a task, on the twin or on hardware."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer
from rich.console import Console

from robotctl.cli.errors import Exit, hear_interrupts, readable_errors
from robotctl.cli.keys import stop_keys
from robotctl.cli.output import write_json
from robotctl.control.acknowledgement import acknowledge, require_acknowledged
from robotctl.control.deadman_device import DeadmanDevice
from robotctl.control.kinematics import Kinematics
from robotctl.control.operator import Verb
from robotctl.control.process_session import ProcessSession
from robotctl.control.recording_session import SessionRecording, record_session
from robotctl.control.session import LockstepSession, Session
from robotctl.hal.can.channel import may_be_real
from robotctl.hal.errors import ConfigError, HardwareError
from robotctl.hal.profile import CLASSIC_HZ
from robotctl.hal.robot import load_robot
from robotctl.learning.actor import Actor, InlineActor, ProcessActor
from robotctl.learning.policies import POLICIES, make_policy
from robotctl.learning.run import Episode, Outcome, report, run_episodes
from robotctl.learning.task import ReachTask, load_task


class Terminated(BaseException):
    """SIGTERM: somebody wants this to end now."""


def run(
    backend: Annotated[str, typer.Option(help="sim: the MuJoCo twin. can: drives on a CAN bus.")] = "sim",
    robot: Annotated[str, typer.Option(help="Name of a shipped robot, or path of a profile.")] = "panda",
    task: Annotated[str, typer.Option(help="Name of a shipped task, or path of a task file.")] = "reach",
    policy: Annotated[
        str, typer.Option(help=f"One of {', '.join(POLICIES)}, or the path of a network (.npz).")
    ] = "scripted",
    channel: Annotated[str, typer.Option(help="CAN only: emulated, virtual:NAME, socketcan:can0, slcan:DEVICE.")] = "",
    episodes: Annotated[int, typer.Option(min=1, help="How many episodes.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the targets and of random policies.")] = 0,
    fast: Annotated[
        bool, typer.Option("--fast", help="Simulation in lockstep, as fast as the machine allows.")
    ] = False,
    record: Annotated[Path | None, typer.Option(help="MCAP file to write; default recordings/TIME-ROBOT.mcap.")] = None,
    deadman: Annotated[
        Path | None, typer.Option(help="Deadman's switch: /dev/input/js0, or what writes lines 0, 1, 2 (see the docs).")
    ] = None,
    accept_limits: Annotated[
        bool, typer.Option("--accept-limits", help="Real drives: the limits are those that the arm should be held to.")
    ] = False,
    json: Annotated[Path | None, typer.Option(help="Write the report here.")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Override a profile key, e.g. twin.lag_s=0.02.")
    ] = None,
) -> None:
    """Let a policy work on a task. Space or Esc is the emergency stop; Ctrl-C brakes, and then switches off."""
    console = Console(highlight=False, soft_wrap=True)
    overrides = list(set_ or [])
    hear_interrupts()
    with readable_errors():
        model = load_robot(robot, overrides)
        if "slcan:" in channel and model.profile.servo_hz > CLASSIC_HZ:
            overrides.append(f"servo_hz={CLASSIC_HZ}")
            model = load_robot(robot, overrides)
            console.print(f"slcan carries classic CAN only: servo rate {CLASSIC_HZ} Hz")
        work = load_task(task)
        make_policy(policy, model, Kinematics(model), seed)  # complains here rather than in its process
        session: Session
        actor: Actor
        if fast and deadman is not None:
            raise ConfigError("nobody holds a switch in lockstep", "leave out --fast, or --deadman")
        if fast:
            session = LockstepSession(model, backend, channel, work.reset)
            actor = InlineActor(session, work, policy, seed)
        else:
            session = ProcessSession(model, backend, channel, overrides, work.reset)
            actor = ProcessActor(session, work, policy, seed, overrides)
        session.on_page = partial(_page, console)
        session.on_switch = partial(console.print, "  hold the switch to start", style="bold")
        name = model.profile.name
        about = {"backend": backend, "robot": name, "task": work.name, "policy": policy, "seed": seed}
        about["limits_hash"] = model.limits_hash
        path = record or Path("recordings") / f"{datetime.now():%Y%m%d-%H%M%S}-{name}-{backend}.mcap"
        console.print(
            f"[bold]{model.profile.title}[/] on {backend}, task {work.name}, {episodes} episodes, seed {seed}"
        )
        real = may_be_real(channel)
        job = Job(session, actor, work, episodes, seed, path, about, overrides, real, accept_limits, deadman)
        try:
            status, result, lost = _carry_out(job, console)
        except Terminated:  # before anything moved, or after everything had come to rest
            raise typer.Exit(Exit.STOPPED_BY_SAFETY) from None
        _summarise(console, result)
        if json is not None:
            write_json(json, result)
        if lost is not None:
            raise lost
    if status is not Exit.DONE:
        raise typer.Exit(status)


@dataclass(frozen=True, slots=True)
class Job:
    """What is to be run, and where it is recorded."""

    session: Session
    actor: Actor
    task: ReachTask
    episodes: int
    seed: int
    path: Path
    about: dict[str, Any]
    overrides: list[str]
    real: bool
    """Whether the drives may be real ones."""
    accept_limits: bool
    deadman: Path | None


def _carry_out(job: Job, console: Console) -> tuple[Exit, dict[str, Any], HardwareError | None]:
    """Run a job to its end, or to wherever a person, a signal or the loss of the hardware ends it."""

    def on_trip(event: dict[str, Any]) -> None:
        console.print(f"  [bold red]stop[/] {event['protection']} (category {event['stop_category']})", end=": ")
        console.print(event["text"], markup=False)

    session, outcome, recording = job.session, Outcome(), SessionRecording(job.path)
    lost: HardwareError | None = None
    recorded = record_session(session, job.path, job.about, on_trip, job.overrides)
    try:
        with _terminable(), _switch(job), session:
            _look_at_limits(job)
            with recorded as recording, job.actor as actor:
                recording.processes["policy"] = actor.pid
                with _stopped_by_errors(session), stop_keys(session.emergency_stop):
                    status = _attempt(job, outcome, console)
                state = session.state.name
    except HardwareError as error:
        status, lost, state = Exit.NO_HARDWARE, error, session.state.name
    result = report(session, outcome, job.about, recording)
    result["safety"]["state"] = state
    result["processes"] = recording.processes
    result["error"] = lost.what if lost is not None else ""
    return status, result, lost


@contextmanager
def _switch(job: Job) -> Iterator[None]:
    """Read the deadman's switch, if there is one."""
    if job.deadman is None:
        yield
    else:
        with DeadmanDevice(job.deadman, job.session.link.desk.hold):
            yield


def _look_at_limits(job: Job) -> None:
    """Let nothing but bring-up happen to real drives before a person has acknowledged the limits of their arm (P25)."""
    if job.real:
        if job.accept_limits:
            acknowledge(job.session.robot)
        require_acknowledged(job.session.robot)


def _attempt(job: Job, outcome: Outcome, console: Console) -> Exit:
    """Run the episodes until they are done, or safety, a person or a signal ends them; the arm is at rest then."""

    def on_episode(index: int, episode: Episode) -> None:
        if episode.refused:
            console.print(f"  episode {index + 1}  refused  P26: {episode.refused}", style="yellow", markup=False)
            return
        mark = "[green]reached[/]" if episode.success else "[yellow]missed[/] "
        distance = f"{1e3 * episode.final_distance_m:7.1f} mm"
        console.print(f"  episode {index + 1}  {mark}  {distance}  {episode.steps:4d} steps")

    session = job.session
    try:
        try:
            run_episodes(session, job.actor, job.task, job.episodes, job.seed, outcome, on_episode)
        except KeyboardInterrupt:
            outcome.stopped = "interrupted"
            console.print("  interrupted: braking, then drives off; Ctrl-C again for drives off at once")
            _wind_down(session)
            return Exit.INTERRUPTED
    except Terminated:
        outcome.stopped = "emergency stop by SIGTERM"
        console.print(f"  {outcome.stopped}")
        session.bring_to_rest(Verb.ESTOP)
    return Exit.STOPPED_BY_SAFETY if outcome.stopped else Exit.DONE


def _page(console: Console, why: str) -> None:
    console.bell()
    console.print(f"  operator, please: {why}", style="bold", markup=False)


def _wind_down(session: Session) -> None:
    try:
        session.wind_down()
    except KeyboardInterrupt:
        session.bring_to_rest(Verb.DISARM)


@contextmanager
def _stopped_by_errors(session: Session) -> Iterator[None]:
    """Stop the arm first when anything goes wrong here: policy and recorder take their time to end."""
    try:
        yield
    except BaseException:
        session.emergency_stop()
        raise


@contextmanager
def _terminable() -> Iterator[None]:
    """Raise `Terminated` in the main thread on SIGTERM."""

    def terminate(_signal: int, _frame: FrameType | None) -> None:
        raise Terminated

    before = signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _summarise(console: Console, result: dict[str, Any]) -> None:
    timing = result["timing"]
    if not timing["ticks"]:
        return
    reached = sum(episode["success"] for episode in result["episodes"])
    violations = result["safety"]["violations"]
    console.print(f"{reached} of {len(result['episodes'])} reached; state {result['safety']['state']}", end="; ")
    console.print(f"violations {sum(violations.values())}, clipped ticks {result['safety']['clipped_ticks']}")
    if timing["tick_us"]:
        late = timing["lateness_us"]["p99"]
        console.print(f"{timing['servo_hz']:.0f} Hz servo, {timing['policy_hz']:.1f} Hz policy; ", end="")
        console.print(
            f"tick p99 {timing['tick_us']['p99']:.0f} us, late p99 {late:.0f} us, {timing['overruns']} overruns"
        )
    if timing["dropped"]:
        console.print(f"[yellow]{timing['dropped']} ticks were overwritten before anybody had judged them[/]")
    if result["stopped"]:
        console.print("[bold red]stopped[/]", end=" ")
        console.print(result["stopped"], markup=False)
    for problem in result["recording_problems"]:
        console.print("[yellow]recording[/]", end=" ")
        console.print(problem, markup=False)
    for path in filter(None, [result["recording"], *result["black_boxes"]]):
        console.print(f"recording {path}", markup=False, soft_wrap=True)
