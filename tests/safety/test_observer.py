"""The momentum observer finds what acts beside the drives."""

import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.hal.robot import load_robot
from robotctl.hal.types import Sample
from robotctl.safety.observer import MomentumObserver

TICK = 2_000_000
AT_REST = np.zeros(7)


PANDA = load_robot("panda")


@pytest.fixture(scope="module")
def kinematics() -> Kinematics:
    return Kinematics(PANDA)


@pytest.fixture
def observer(kinematics: Kinematics) -> MomentumObserver:
    return MomentumObserver(7, kinematics)


def sample(stamp, position, velocity, effort, enabled=True, stamps=None):
    stamps = np.full(7, stamp) if stamps is None else stamps
    return Sample(stamp, position, velocity, effort, stamps, (), enabled)


def swing(observer, kinematics, home, external, ticks=100, dt=2e-3, amplitude=0.5):
    """Let the arm move smoothly under a constant torque from outside, and return what is found at the end."""
    for tick in range(ticks):
        time = tick * dt
        position = home + amplitude / 2.0 * (1.0 - np.cos(2.0 * time)) * np.ones(7)
        velocity = amplitude * np.sin(2.0 * time) * np.ones(7)
        acceleration = 2.0 * amplitude * np.cos(2.0 * time) * np.ones(7)
        effort = (
            kinematics.inverse_dynamics(position, velocity, acceleration) + kinematics.damping * velocity - external
        )
        found = observer.step(sample(round(time * 1e9), position, velocity, effort))
    return found


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("dt", [2e-3, 5e-3])
def test_a_torque_from_outside_is_found_while_the_arm_moves(observer, kinematics, panda, joint, dt):
    external = np.zeros(7)
    external[joint] = 3.0
    found = swing(observer, kinematics, np.array(panda.profile.home), external, dt=dt)
    assert found == pytest.approx(external, abs=0.15)
    assert observer.external is found


def test_it_is_found_first_order_with_5_ms(observer, kinematics, panda):
    home, external = np.array(panda.profile.home), np.ones(7)
    effort = kinematics.gravity(home) - external
    found = [observer.step(sample(tick * TICK, home, AT_REST, effort))[0] for tick in range(6)]
    assert found == pytest.approx([1.0 - (1.0 / 1.4) ** tick for tick in range(6)], abs=1e-6)


def test_with_the_drives_off_nothing_is_found_and_it_starts_anew(observer, kinematics, panda):
    home = np.array(panda.profile.home)
    swing(observer, kinematics, home, np.ones(7))
    assert (observer.step(sample(10**9, home, AT_REST, AT_REST, enabled=False)) == 0.0).all()
    assert (observer.step(sample(10**9 + TICK, home, AT_REST, AT_REST)) == 0.0).all()
    found = observer.step(sample(10**9 + 2 * TICK, home, AT_REST, AT_REST))
    assert found == pytest.approx(kinematics.gravity(home) * (1.0 - 1.0 / 1.4), abs=1e-6)


def test_while_a_joint_is_not_heard_of_nothing_new_is_found(observer, kinematics, panda):
    home = np.array(panda.profile.home)
    found = swing(observer, kinematics, home, np.ones(7), ticks=50).copy()
    now = 50 * TICK
    stamps = np.full(7, now)
    stamps[3] = 49 * TICK
    heard = swing(observer, kinematics, home, np.ones(7), ticks=50)
    assert heard == pytest.approx(found, abs=0.5)
    before = observer.external
    assert observer.step(sample(now, home, AT_REST, AT_REST, stamps=np.full(7, 49 * TICK))) is before


@pytest.mark.parametrize(("gap_ms", "goes_on"), [(9, True), (10, False), (45, False)])
def test_after_a_gap_what_was_found_stays_and_is_followed_from_there(observer, kinematics, panda, gap_ms, goes_on):
    home = np.array(panda.profile.home)
    effort = kinematics.gravity(home) - 1.0
    for tick in range(50):
        before = observer.step(sample(tick * TICK, home, AT_REST, effort))
    late = 49 * TICK + gap_ms * 1_000_000
    found = observer.step(sample(late, home, AT_REST, effort + 1.0))
    assert (found is before) is not goes_on
    if not goes_on:
        again = observer.step(sample(late + TICK, home, AT_REST, effort))
        assert again == pytest.approx(np.full(7, 1.0 - 1.0 / 1.4), abs=1e-6)


def test_the_present_is_the_sample_led_on_by_its_age(observer, kinematics, panda):
    home = np.array(panda.profile.home)
    velocity = np.full(7, 0.1)
    torque = kinematics.bias(home, velocity) + kinematics.damping * velocity
    position, now = observer.present(sample(5 * TICK, home, velocity, torque), torque)
    assert position == pytest.approx(home)
    assert now == pytest.approx(velocity)
    late = sample(5 * TICK, home, velocity, torque, stamps=np.full(7, 4 * TICK))
    position, now = observer.present(late, torque)
    assert position == pytest.approx(home + 2e-4, abs=1e-9)
    assert now == pytest.approx(velocity, abs=1e-9)
    push = torque + kinematics.mass_matrix(home) @ np.full(7, 2.0)
    position, now = observer.present(late, push)
    assert now == pytest.approx(velocity + 2e-3 * 2.0, abs=1e-3)
    assert position == pytest.approx(home + 2e-3 * (velocity + 2e-3), abs=1e-5)


class Dragged:
    """Joints of 2 kg m^2 without coupling, whose viscous friction is large."""

    damping = np.full(7, 50.0)

    def mass_matrix(self, position):
        return 2.0 * np.eye(7)

    def coriolis(self, position, velocity):
        return np.zeros((7, 7))

    def gravity(self, position):
        return np.full(7, 4.0)

    def bias(self, position, velocity):
        return self.gravity(position)


def test_viscous_friction_is_known(panda):
    observer, velocity = MomentumObserver(7, Dragged()), np.full(7, 0.2)
    for tick in range(50):
        found = observer.step(sample(tick * TICK, AT_REST + tick * 4e-4, velocity, np.full(7, 4.0 + 10.0)))
    assert found == pytest.approx(AT_REST, abs=1e-9)


@pytest.mark.parametrize(("ages_ms", "goes_on"), [((2, 4), True), ((2, 12), False), ((0, 4), False), ((-1, 2), False)])
def test_every_joint_has_to_be_heard_of_again_and_soon(ages_ms, goes_on):
    observer = MomentumObserver(7, Dragged())
    pushed, begun = np.full(7, 4.0 - 1.0), np.full(7, 100 * TICK)
    for tick in range(101):
        before = observer.step(sample(tick * TICK, AT_REST, AT_REST, pushed))
    stamps = begun + 1_000_000 * np.array([ages_ms[0]] * 6 + [ages_ms[1]])
    found = observer.step(sample(int(stamps.max()), AT_REST, AT_REST, pushed + 3.0, stamps=stamps))
    assert (found is not before) is goes_on


@pytest.mark.parametrize("external", [-3.0, 3.0])
def test_what_was_observed_and_what_rubs_act_until_now(external):
    """Per joint by itself: (M + age D) dv = age (tau + r - g - D v), and half of dv acts on the way."""
    observer, velocity, torque = MomentumObserver(7, Dragged()), np.full(7, 0.2), np.full(7, 30.0)
    observer.external = np.full(7, external)
    ages = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 20.0]) * 1e-3
    stamps = 100_000_000 - np.round(1e9 * ages).astype(np.int64)
    position, now = observer.present(sample(100_000_000, AT_REST, velocity, torque, stamps=stamps), torque)
    change = ages * (30.0 + external - 4.0 - 10.0) / (2.0 + ages * 50.0)
    assert now == pytest.approx(velocity + change)
    assert position == pytest.approx(ages * (velocity + 0.5 * change))
