"""Scenes in which elements switch: a move, a contact, and random scenes."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from elements import ARM, HOOK, TIP, Hold

import fdof_jax as fj

RODS = fj.Linkage(
    "RRR", length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1, 1, 1], inertia=[0.1] * 3
)


class Case(eqx.Module):
    """Numbers of a scene that has all elements: a limited PD and a damped contact."""

    gain: float
    contact: float
    side: int
    rest: float
    end: float


LIMITED = Case(1.0, 0.0, 1, 1.9, 1.0)
CABLE = Case(0.0, 1.0, 1, 1.9, 0.8)


def scene(x, case):
    """A move by limited efforts from the time x on, or a fall from the angle x."""
    limited = case.gain > 0
    q0, qd0 = jnp.array([0.2, 0.4, -0.3]), jnp.array([0.3, -0.5, 0.4])
    begin = jnp.where(limited, x, 0.1)
    travel = fj.references.Travel(0.7, begin=begin, profile="trapezoidal")
    move = fj.references.JointMove(q0, q0 + 0.5, travel)
    pd = fj.PDController(80 * case.gain, 8 * case.gain, 10, move)
    spring = fj.SpringDamper(
        fj.Point(0, 0.0, 1.0), fj.Point(1, 1.0), one_sided="cable",
        stiffness=200 * case.contact, damping=20 * case.contact, rest_length=case.rest,
    )  # fmt: skip
    spring = eqx.tree_at(lambda spring: spring.side, spring, jnp.asarray(case.side))
    fall = jnp.zeros(3).at[0].set(x)
    start = fj.State(jnp.where(limited, q0, fall), jnp.where(limited, qd0, 0))
    return fj.Scene(RODS, start, (pd, spring, fj.JointDamper(case.contact)), case.end)


ELEMENTS = "a limited controller", "a cable", "a bumper", "stops", "a speed limit"
EACH = 9  # scenes of each topology, for each element
GOAL = Hold(jnp.array([0.4, -0.3, 0.6]))


def elements_of(size, acts):
    """A limited PD, a cable or bumper, stops and a drive.

    `acts` (5,) is 1 for one of `ELEMENTS`.
    """
    pd, cable, bumper, stops, drive = acts
    contact = fj.SpringDamper(
        HOOK, TIP, one_sided="cable", stiffness=300.0 * size * (cable + bumper),
        damping=15.0 * size * (cable + bumper),
        rest_length=size * jnp.where(bumper > 0, 1.95, 1.2),
    )  # fmt: skip
    side = jnp.where(bumper > 0, -1, 1)
    contact = eqx.tree_at(lambda spring: spring.side, contact, side)
    inner = fj.PDController(60.0 * drive, 4.0 * drive, jnp.inf, GOAL)
    return (
        fj.PDController(60.0 * pd, 4.0 * pd, 8.0 * size, GOAL),
        contact,
        fj.forces.JointStops(
            -0.3, 0.6 * size, stiffness=500.0 * stops + 1e-9,
            damping=0.1, smoothing=0.02,
        ),
        fj.control.SpeedLimit(inner, stall=20.0 * size, no_load=4.0),
        fj.JointDamper(0.2),
    )  # fmt: skip


MOVING = "a limited PID", "a motor"  # controllers with a state, in a move


def moving_elements(size, acts, start):
    """A limited PID and a DC motor, whose references move; `acts` (2,) is 1 for one."""
    pid, motor = acts
    travel = fj.references.Travel(0.25, begin=0.1 * size, profile="trapezoidal")
    move = fj.references.JointMove(start, start + 0.4, travel)
    volts = fj.PDController(300.0 * motor, 30.0 * motor, jnp.inf, move)
    return (
        fj.control.PIDController(60.0 * pid, 90.0 * pid, 6.0 * pid, 8.0 * size, move),
        fj.control.DCMotor(
            volts, resistance=2.0, inductance=0.05, constant=0.2, gear=10.0,
            voltage_limit=24.0 * size, current_limit=8.0,
        ),
        fj.JointDamper(0.2),
    )  # fmt: skip


def random_members(elements=ELEMENTS) -> Any:
    """Existence factors, starts and the acting element: (scene, ...) each."""
    rng = np.random.default_rng(3)
    count = len(fj.TOPOLOGIES) * EACH
    ef = np.array([np.array(fj.existence_factors(name)) for name in fj.TOPOLOGIES])
    q, qd = rng.uniform(-0.2, 0.5, (count, 3)), rng.uniform(-2, 2, (count, 3))
    each = np.repeat(ef, EACH, axis=0), q, qd
    scenes = [np.tile(rows, (len(elements), 1)) for rows in each]
    acts = np.repeat(np.eye(len(elements)), count, axis=0)
    return jax.tree.map(jnp.asarray, (*scenes, acts))


def random_scene(size, mass, shift, member) -> fj.Scene:
    """Returns a member's scene: size of the element, masses' factor, change of q."""
    ef, q, qd, acts = member
    arm = fj.Linkage(ef, **ARM | {"mass": jnp.array(ARM["mass"]) * mass})
    if acts.shape[-1] == len(MOVING):
        forces = moving_elements(size, acts, q)
    else:
        forces = elements_of(size, acts)
    return fj.Scene(arm, fj.State(q + shift, qd), forces, 0.4)
