"""Plots of energies add up, and their balance holds."""

import elements
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from figures import (
    LINKAGE,
    labels,
    made_up,
    make_linkage,
    swinging,
    tidy as tidy,
    tops,
    values,
)

from fdof_jax import (
    JointDamper,
    JointEffort,
    Linkage,
    Point,
    Solution,
    State,
    plotting,
    scenes,
    simulate,
    simulate_sampled,
)  # fmt: skip
from fdof_jax.forces import Brake, HardStops, JointFriction, JointStops, Payload


def test_energy_profile_adds_up():
    fig = plotting.energy_profile(make_linkage("PRR"), swinging())
    kinetic, potential, whole = fig.axes
    assert all("[J]" in ax.get_ylabel() for ax in fig.axes)
    assert labels(kinetic) == ["link 1", "link 2", "link 3"]
    assert labels(whole) == ["kinetic", "potential", "total"]
    sums = [sum(values(ax)) for ax in (kinetic, potential)]
    for total, expected in zip(values(whole), (*sums, sums[0] + sums[1])):
        np.testing.assert_allclose(total, expected, atol=1e-12)


LIFT = make_linkage("PPR")
MASS, DAMPING, STIFFNESS = 4.0, 3.0, 50.0


def lifted(effort: float, end: float = 2.0) -> tuple[tuple, Solution]:
    """Returns an exact motion: the first slide on a damped stop under an effort.

    The other joints stand still, and all masses move with the slide.
    """
    damper = JointDamper([DAMPING, 0, 0])
    stops = JointStops([0, -np.inf, -np.inf], np.inf, stiffness=STIFFNESS)
    weight = MASS * 9.81 * np.cos(0.4)
    rest = (effort - weight) / STIFFNESS
    rate = np.roots([MASS, DAMPING, STIFFNESS])[0]
    swing = 0.2 * (1 + 1j * rate.real / rate.imag)  # starts with no speed
    ts = np.linspace(0, end, 401)
    q, qd = np.zeros((2, 401, 3))
    q[:, 0] = rest + np.real(swing * np.exp(rate * ts))
    qd[:, 0] = np.real(rate * swing * np.exp(rate * ts))
    return (damper, stops, JointEffort([effort, 0, 0])), made_up(ts, q, qd)


@pytest.mark.slow
def test_energy_stack_keeps_its_top_where_energy_is_only_taken_out():
    forces, solution = lifted(0.0)
    ax = plotting.energy_stack(LIFT, forces, solution)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time [s]", "energy [J]")
    assert labels(ax) == ["kinetic", "potential", "taken out", "at the start"]
    stack = tops(ax, solution.ts)
    top, (line,) = stack["taken out"], values(ax)
    np.testing.assert_allclose(line, line[0], rtol=1e-9)
    np.testing.assert_allclose(top, line, rtol=1e-4)
    kinetic = MASS * np.asarray(solution.qd)[:, 0] ** 2 / 2
    np.testing.assert_allclose(stack["kinetic"], kinetic, atol=1e-12)
    potential = stack["potential"] - stack["kinetic"]
    assert potential.min() == 0 and potential.max() > 0.5
    taken = top - stack["potential"]
    assert taken[0] == 0 and taken[-1] > 0.5 and np.diff(taken).min() > -1e-9
    # The trapezoidal rule is of the second order.
    forces, long = lifted(0.0, 4.0)
    coarse = tops(plotting.energy_stack(LIFT, forces, long), long.ts)["taken out"]
    worse = np.abs(coarse - line[0]).max() / np.abs(top - line[0]).max()
    assert 2**2 / 1.5 < worse < 2**2 * 1.5


@pytest.mark.slow
def test_energy_stack_rises_by_what_is_put_in():
    forces, solution = lifted(20.0)
    ax = plotting.energy_stack(LIFT, forces, solution)
    assert labels(ax)[-1] == "start + put in"
    top, (line,) = tops(ax, solution.ts)["taken out"], values(ax)
    np.testing.assert_allclose(top, line, rtol=1e-5)
    steps = np.diff(solution.q[:, 0])
    assert steps.min() < 0 < steps.max()  # it drives and brakes
    put_in = 20 * np.maximum(steps, 0).sum()
    np.testing.assert_allclose(line[-1] - line[0], put_in, rtol=1e-3)


@pytest.mark.slow
def test_energy_stack_of_a_free_arm_and_of_what_was_reached():
    solution = swinging(21)
    solution = eqx.tree_at(lambda s: s.q, solution, solution.q.at[11:].set(jnp.nan))
    ax = plotting.energy_stack(LINKAGE, (), solution)
    end = "ended at 0.5 s:\nsuccessful"
    assert labels(ax) == ["kinetic", "potential", "at the start", end]
    assert ax.get_xlim() == (0, 1)


@pytest.mark.slow
def test_energy_stack_balances_with_elements_of_each_kind():
    """With and without an energy, a state and masses.

    That each element's power is what its energy loses is tested in test_elements.py.
    """
    arm, start = elements.arm("RPR"), elements.START
    kinds = "history", "spring", "motor", "armature"
    forces = tuple(elements.ALL[kind] for kind in (*kinds, "actuator"))
    ts = np.linspace(0, 0.075, 501)
    # One step per sample.
    solution = simulate(arm, start, ts, forces, **elements.SHORT | dict(dt0=ts[1]))
    ax = plotting.energy_stack(arm, forces, solution)
    top, (line,) = tops(ax, solution.ts)["taken out"], values(ax)
    np.testing.assert_allclose(top, line, rtol=1e-5)


BALL = Linkage("P", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1])
BAR = Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12])
ARM = scenes.double_pendulum().linkage
TIP = Point(1, along=1)
TS = np.linspace(0, 2, 401)


def holding(
    level=0.0, static=0.0, lower=-np.inf, upper=np.inf, brake=Brake(1, 9, 10),
    taken=(9.0, 10.0), damping=0.0,
):  # fmt: skip
    """Returns elements for two joints; those of no effect let all share a program."""
    both = lambda value: np.broadcast_to(value, 2).astype(float)
    return (
        JointFriction(both(level), both(static)),
        HardStops(both(lower), both(upper), restitution=0.5), brake,
        Payload(Point(2, 0.8), 0.5, begin=taken[0], end=taken[1]), JointDamper(damping),
    )  # fmt: skip


def with_fixed(link: Linkage, start: State) -> tuple[Linkage, State]:
    """Returns the link with a fixed one of no mass at its end."""
    more = dict(length=[0, 1, 0], com=[*link.com, [0, 0]], mass=[1, 0])
    kinds = "RF" if link is BAR else "PF"
    arm = link.replace(topology=kinds, inertia=[*link.inertia, 0], locked=0.0, **more)
    return arm, State(*(np.append(row, 0.0) for row in start))


FALLING, TURNING = State([1.0], [0.0]), State([0.3], [1.0])
OF_ALL_KINDS = holding(
    [1.0, 0.5], [1.5, 0.8], [-2, -1], [2, 1], Brake(2, 0.9, 1.2), (0.5, 1.5), 0.5
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("linkage", "start", "forces"),
    [
        (*with_fixed(BALL, FALLING), holding(lower=0.0, damping=1.0)),
        (*with_fixed(BAR, TURNING), holding(0.5, 0.7, -0.4, brake=Brake(1, 0.2, 0.6))),
        (*with_fixed(BAR, TURNING), holding(brake=Brake(1, 0.0, 0.6))),  # a blow at 0
        (ARM, State(np.array([0.3, 0.0]), np.zeros(2)), OF_ALL_KINDS),
    ],
    ids=["stop and damper", "friction, stop and brake", "braked first", "all"],
)
def test_energy_stack_balances_where_joints_are_held(linkage, start, forces):
    solution = simulate(linkage, start, TS, forces)
    ax = plotting.energy_stack(linkage, forces, solution)
    stack, (line,) = tops(ax, TS), values(ax)
    damped = np.any(forces[-1].coefficient)  # at blows its effort jumps
    rtol = 1e-2 if damped else 1e-8
    np.testing.assert_allclose(stack["taken out"], line, rtol=rtol)
    taken = np.asarray(solution.taken) - solution.taken[0]
    out = stack["taken out"] - stack["potential"]
    if not damped:
        np.testing.assert_allclose(out, taken, atol=1e-9)
    assert np.all(out >= taken - 1e-9)


@pytest.mark.slow
def test_energy_stack_of_sampled_control_has_what_holders_take():
    """As much as beside the same efforts, all 0, without a clock."""
    forces = JointFriction(1.0), Brake(1, 0.25, 0.5), HardStops(-0.5, 2)
    effort, start = JointEffort([0.0]), State([0.4], [0.3])
    motion = simulate_sampled(BAR, start, effort, 0.05, 30, forces)
    whole = simulate(BAR, start, motion.ts, forces)
    assert whole.events.count == 3  # it brakes, falls and hits its stop
    np.testing.assert_allclose(motion.taken, whole.taken, atol=1e-9)
    ax = plotting.energy_stack(BAR, (effort, *forces), motion)
    np.testing.assert_allclose(
        tops(ax, motion.ts)["taken out"], values(ax)[0], rtol=1e-6
    )


@pytest.mark.slow
def test_energy_stack_integrates_friction_whose_level_is_a_function():
    """The motion does not count what it takes; a level of numbers is counted."""
    friction = JointFriction(lambda t, q, qd, linkage: 2.0), JointFriction(1.0)
    ts = np.linspace(0, 0.5, 501)
    solution = simulate(BAR, State([0.3], [1.0]), ts, friction)
    taken = 3 * np.abs(np.diff(solution.q[:, 0])).sum()
    np.testing.assert_allclose(solution.taken[-1], taken / 3, rtol=1e-4)
    ax = plotting.energy_stack(BAR, friction, solution)
    stack = tops(ax, ts)
    out = stack["taken out"] - stack["potential"]
    np.testing.assert_allclose(out[-1], taken, rtol=1e-4)


@pytest.mark.slow
def test_energy_stack_has_what_payloads_bring_and_take_away():
    times = dict(begin=0.5, end=1.2037)
    load = Payload(TIP, 1.5, 0.1, velocity=[0.3, 0.2], **times)
    ts = np.sort(np.append(TS, times["end"]))
    solution = simulate(BAR, State([0.3], [1.0]), ts, (load,))
    ax = plotting.energy_stack(BAR, (load,), solution)
    stack, (line,) = tops(ax, ts), values(ax)
    np.testing.assert_allclose(stack["taken out"], line, rtol=1e-8)
    out = stack["taken out"] - stack["potential"]
    height = lambda q: 1.5 * 9.81 * np.sin(q)
    brings = 1.5 * (0.3**2 + 0.2**2) / 2 + height(np.interp(0.5, ts, solution.q[:, 0]))
    end = list(ts).index(times["end"])
    q, qd = solution.q[end, 0], solution.qd[end, 0]
    leaves = (1.5 + 0.1) * qd**2 / 2 + height(q)
    # Below the pivot, what is taken has a negative energy, and also what is let go.
    assert brings < 0 and leaves < 0
    np.testing.assert_allclose(out[-1], solution.taken[-1] - brings, rtol=1e-7)
    np.testing.assert_allclose(line[-1] - line[0], -leaves, rtol=1e-7)
    # One that is there from the start on, and one that the arm does not let go.
    for times in (dict(end=1.2), dict(begin=0.5)):
        forces = (Payload(TIP, 1.5, **times),)
        solution = simulate(BAR, State([0.3], [1.0]), ts, forces)
        ax = plotting.energy_stack(BAR, forces, solution)
        np.testing.assert_allclose(tops(ax, ts)["taken out"], values(ax)[0], rtol=1e-8)
