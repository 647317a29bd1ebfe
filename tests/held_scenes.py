"""Random scenes whose joints are held for a while: laws and derivatives.

`python tests/held_scenes.py` looks at 400 of them, and prints what is out of bounds;
test_holding.py looks at some. Scenes of as many joints share programs, which compile
for minutes each.
"""

import sys
from functools import partial
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from modes import ADJOINT, LOOPS

import fdof_jax as fj
from fdof_jax.forces import HardStops, JointFriction

NEVER = 9.0  # after the end of all motions [s]
TS = np.linspace(0, 2, 41)
# Tolerances, as arrays: one program serves both.
DEFAULT, TIGHT = np.array(1e-11), np.array(1e-13)


class Held(NamedTuple):
    linkage: Any
    state0: Any
    forces: tuple

    def at(self, t):
        """Returns the elements at a time: payloads without mass where not taken."""
        inertial = fj.forces.InertialElement
        return tuple(e.at(t) if isinstance(e, inertial) else e for e in self.forces)

    def numbers(self):
        """Returns the numbers of start and elements, and back to a scene."""
        varied = self.state0, self.forces
        numbers, whole = ravel_pytree(eqx.filter(varied, eqx.is_inexact_array))

        def of_numbers(x):
            return Held(self.linkage, *eqx.combine(whole(x), varied))

        return numbers, of_numbers


def random_scene(rng, moving=False):
    """Returns one to five joints, with a spring and one to four elements that hold.

    The others of the four are there too, but never act.

    `moving`: whether all joints move at the start, and so derivatives exist.
    """
    n = int(rng.integers(1, 6))
    while True:
        topology = "".join(rng.choice(list("RRP"), n))
        if topology.count("P") <= 2 and ("R" in topology or n == 1):
            break
    turns = np.array(list(topology)) == "R"
    linkage = fj.Linkage(
        topology,
        length=rng.uniform(0.3, 1, n + 1),
        com=rng.uniform(-0.3, 0.5, (n, 2)),
        mass=rng.uniform(0.5, 2, n),
        inertia=rng.uniform(0.05, 0.3, n),
        locked=np.where(turns, rng.uniform(0, 0.3, n), rng.uniform(-1, 1, n)),
        base_angle=rng.uniform(-3, 3),
        gravity=rng.choice([0.0, 9.81]),
    )
    rests = np.zeros(n, bool) if moving else rng.random(n) > 0.7
    start = fj.State(
        rng.uniform(-0.8, 0.8, n), np.where(rests, 0, rng.uniform(-2, 2, n))
    )
    level = rng.uniform(0.05, 3, n)
    ends = np.where(rng.random((2, n)) < 0.5, rng.uniform(1, 1.05, (2, n)), np.inf)
    begin = rng.uniform(0.2, 1)
    static = level * rng.uniform(1.01, 1.5)
    restitution, braked = rng.uniform(0, 0.8, n), int(rng.integers(1, n + 1))
    mass, taken = rng.uniform(0.2, 2), rng.uniform(0.2, 1)
    some = rng.random(4) < [0.8, 0.7, 0.4, 0.4]
    some[int(rng.integers(4))] = True
    rubs, stops, brakes, carries = some
    begin, taken = begin if brakes else NEVER, taken if carries else NEVER
    lower, upper = np.where(stops, ends, np.inf)
    forces = (
        fj.forces.JointSpring(rng.uniform(1, 30, n)),
        JointFriction(rubs * level, static=rubs * static),
        HardStops(-lower, upper, restitution=restitution),
        fj.forces.Brake(braked, begin, begin + 0.5),
        fj.forces.Payload(
            fj.Point(n, 0.2, 0.1), mass, 0.1, begin=taken, velocity=[0.1, -0.2]
        ),
    )
    return Held(linkage, fj.State(*map(jnp.asarray, start)), forces)


def books(scene, motion):
    """Returns the energy and what was taken of it, and the size of the largest part.

    A payload that is taken brings its energies with it.
    """

    def energies(t, q, qd):
        kinetic, potential = fj.energy(scene.linkage, q, qd, scene.at(t))
        return jnp.stack([kinetic, potential])

    parts = np.asarray(jax.vmap(energies)(motion.ts, motion.q, motion.qd))
    taken = np.asarray(motion.taken)
    total = parts.sum(axis=1) + taken
    for element in scene.forces:
        if isinstance(element, fj.forces.Payload):
            later = np.asarray(motion.ts) >= element.begin
            first = np.argmax(later)
            total[later] -= total[first] - total[first - 1]
    return total, max(np.abs(parts).max(), np.abs(taken).max(), 1e-3)


def law_errors(seed):
    """Returns the errors of a scene's laws, as parts of their bounds."""
    scene = random_scene(np.random.default_rng(seed))
    # At the default tolerance some energies are off by 2e-9.
    options = dict(rtol=1e-12, atol=1e-12)
    motion = fj.simulate(scene.linkage, scene.state0, TS, scene.forces, **options)
    total, size = books(scene, motion)
    off = np.abs(total - total[0]) / size
    held, q = np.asarray(motion.modes) > 0, np.asarray(motion.q)
    efforts = fj.joint_efforts(scene.linkage, scene.forces, motion)
    qdd = _accelerations(scene, motion, efforts.total)
    _, friction, stops, *_ = scene.forces
    rubbing = np.abs(efforts.elements[1]) - np.where(
        held, friction.static, friction.level
    )
    lower, upper = np.asarray(stops.lower), np.asarray(stops.upper)
    outside = np.maximum(lower - q, q - upper)
    return {
        "energy at the end": off[-1] / 1e-9,
        # Between ends of steps, states are less exact.
        "energy on the way": off.max() / 1e-8,
        "rates of held joints": np.inf if (motion.qd * held != 0).any() else 0.0,
        "accelerations of held joints": np.abs(qdd * held).max() / 1e-8,
        "friction above its level": rubbing.max() / 1e-9,
        "positions beyond stops": outside.max() / 1e-12,
    }


@eqx.filter_jit
def _accelerations(scene, motion, efforts):
    """Returns those by forward dynamics under the efforts of all elements."""

    def qdd(t, q, qd, effort):
        return fj.forward_dynamics(scene.linkage, q, qd, effort, scene.at(t))

    return jax.vmap(qdd)(motion.ts, motion.q, motion.qd, efforts)


compiled = partial(eqx.filter_jit, **LOOPS)


def _end(x, scene, tolerance, weights, adjoint):
    """Returns weighted last positions and velocities, a function of the numbers."""
    varied = scene.numbers()[1](x)
    motion = fj.simulate(
        varied.linkage, varied.state0, np.array([0, 0.7, 1.3]), varied.forces,
        rtol=tolerance, atol=tolerance, adjoint=adjoint, throw=False,
    )  # fmt: skip
    return weights @ jnp.concatenate([motion.q[-1], motion.qd[-1]])


@compiled
def reverse(x, *at):
    return jax.value_and_grad(partial(_end, adjoint=ADJOINT))(x, *at)


@compiled
def forward(x, *at):
    def twice(x):
        return (_end(x, *at, diffrax.ForwardMode()),) * 2

    return jax.jacfwd(twice, has_aux=True)(x)[::-1]


def derivative_errors(seed, mode):
    """Returns the errors of the derivatives of a mode as parts of their bounds.

    They are compared with extrapolated differences of tight solves, in a direction at
    random.
    """
    rng = np.random.default_rng(1000 + seed)
    scene = random_scene(rng, moving=True)
    numbers, _ = scene.numbers()
    # Infinite stops stay so, and friction of level 0, which may not become negative.
    varied = np.isfinite(numbers) & (numbers != 0)
    direction = np.where(varied, rng.standard_normal(numbers.size), 0)
    weights = rng.standard_normal(2 * len(scene.linkage.mass))

    def difference(h):
        shifted = (numbers + h * sign * direction for sign in (1, -1))
        after, before = (mode(x, scene, TIGHT, weights)[0] for x in shifted)
        return (after - before) / (2 * h)

    # The best of several: rounding weighs more in closer ones, and some motions have an
    # event more or less within wider ones.
    extrapolated = np.array(
        [(4 * difference(h) - difference(2 * h)) / 3 for h in (1e-4, 3e-5, 1e-5, 3e-6)]
    )
    errors = {}
    for tolerance, bound in ((DEFAULT, 1e-6), (TIGHT, 1e-8)):
        slopes = np.where(varied, mode(numbers, scene, tolerance, weights)[1], 0)
        size = max(1, np.abs(slopes).max()) * np.sqrt(varied.sum())
        off = np.abs(slopes @ direction - extrapolated).min() / size
        errors[f"derivatives at {tolerance:g}"] = off / bound
    return errors


def main():
    """Looks at 400 scenes and prints errors above their bounds."""
    fj.configure(x64=True)
    broken = 0
    for seed in range(400):
        errors = law_errors(seed)
        for mode in (reverse, forward):
            found = derivative_errors(seed, mode).items()
            errors |= {f"{mode.__name__} {name}": e for name, e in found}
        wrong = {name: float(e) for name, e in errors.items() if not e <= 1}
        if wrong:
            broken += 1
            print(seed, wrong)
    print(f"{broken} of 400 scenes have errors above their bounds")
    sys.exit(broken > 0)


if __name__ == "__main__":
    main()
