"""Numbers of motions and derivatives, frozen, to compare a later state of the library.

    python -m benchmarks.frozen write FILE.npz [GROUP ...]
    python -m benchmarks.frozen compare FILE.npz [GROUP ...]

A group is a kind of scene and an engine of derivatives; each is one program. All scenes
are those of the tests, at the default tolerance. `compare` prints the largest
differences of each group, and exits with 1 if one is beyond its bound. All of it takes
about ten minutes of a core, nearly all to compile. Second derivatives are left out
where they take several: of speed limits, moving references, holders, dictionaries.

Beside each number stands how much it changes with the tolerance: a motion that grazes
a zero, or is chaotic, amplifies any change in the order of operations. Where that is
more than the bound, it is the bound.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

os.environ["JAX_ENABLE_X64"] = "1"  # before the tests' modules make arms

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

import fdof_jax as fj

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
import elements
import held_scenes as held
import switching_scenes as switching
import test_brief_switches as pegs
import test_derivatives_at_rest as rest
from modes import ADJOINT, LOOPS

# Differences of states and derivatives relative to the largest of a scene, or to 1 if
# that is less; of steps relative to those of the group, or one a scene.
BOUNDS = {"ends": 1e-10, "first": 2e-9, "second": 2e-9, "switches": 0.5}
STEPS = 0.03
# The tolerance, and others over it whose numbers show how certain those are.
TOLERANCE, OTHERS = 1e-11, (1.1, 2.0)
UNCERTAIN = 5.0  # so many times the largest change with the tolerance is allowed

Rows = dict[str, Any]
FORWARD = diffrax.ForwardMode()
BY_TANGENTS = diffrax.RecursiveCheckpointAdjoint()


class Scenes(NamedTuple):
    """Scenes of one structure.

    - `motion(x, member, **options)`: simulates a member, `x` (n,) being what varies.
    - `members`: with a leading axis.
    - `at(member)`: the `x` of a member as it is.
    """

    motion: Callable[..., fj.Solution]
    members: Any
    at: Callable[[Any], Array]


# Engines


def _end(scenes: Scenes, x, member, tolerance, **options) -> tuple[Array, Rows]:
    """Returns the last state, and it again with the numbers of steps and switches."""
    options |= dict(rtol=tolerance, atol=tolerance, throw=False)
    found = scenes.motion(x, member, **options)
    ends = jnp.concatenate([found.q[-1], found.qd[-1]])
    switches = found.stats.get("num_switches", jnp.zeros((), int))
    if found.events is not None:
        switches += found.events.count.astype(int)
    return ends, dict(ends=ends, steps=found.stats["num_steps"], switches=switches)


def forward(scenes: Scenes, member, tolerance) -> Rows:
    """Returns derivatives in forward mode."""
    end = partial(_end, scenes, member=member, tolerance=tolerance, adjoint=FORWARD)
    first, rows = jax.jacfwd(end, has_aux=True)(scenes.at(member))
    return rows | dict(first=first)


def twice(scenes: Scenes, member, tolerance) -> Rows:
    """Also returns how derivatives change if all of x grows."""
    end = partial(_end, scenes, member=member, tolerance=tolerance, adjoint=FORWARD)
    slope, x = jax.jacfwd(end, has_aux=True), scenes.at(member)
    first, second, rows = jax.jvp(slope, (x,), (jnp.ones_like(x),), has_aux=True)
    return rows | dict(first=first, second=second)


def tangents(scenes: Scenes, member, tolerance) -> Rows:
    """Returns derivatives as `jax.grad` takes them in few numbers."""
    end = partial(_end, scenes, member=member, tolerance=tolerance, adjoint=BY_TANGENTS)
    first, rows = jax.jacrev(end, has_aux=True)(scenes.at(member))
    return rows | dict(first=first)


def adjoint(scenes: Scenes, member, tolerance) -> Rows:
    """Returns derivatives of a weighted sum by the adjoint of the steps."""

    def total(x):
        ends, rows = _end(scenes, x, member, tolerance, adjoint=ADJOINT)
        return jnp.cos(jnp.arange(ends.size)) @ ends, rows

    first, rows = jax.grad(total, has_aux=True)(scenes.at(member))
    return rows | dict(first=first)


def plain(scenes: Scenes, member, tolerance) -> Rows:
    """Returns no derivatives, from the solver for batches."""
    return _end(scenes, scenes.at(member), member, tolerance)[1]


# Scenes


def _switching(kinds: tuple[str, ...], acting: slice = slice(None)) -> Scenes:
    """Scenes of random arms; `acting`: the elements that are kept."""

    def motion(x, member, **options):
        arm, start, forces, t1 = switching.random_scene(*x, member)
        ts = jnp.array([0, t1])
        return fj.simulate(arm, start, ts, forces[acting], **options)

    members = switching.random_members(kinds)
    return Scenes(motion, members, lambda member: jnp.array([1.0, 1.0, 0.0]))


def _pegs() -> Scenes:
    """Pegs of two radii, of which the start, the radius and the stiffness vary."""
    rng = np.random.default_rng(5)
    q, qd = rng.uniform(-2, 2, (60, 2)) + [0.5, 0], rng.uniform(-3, 3, (60, 2))
    aside = rng.uniform(-0.6, 0.6, (60, 2))
    radius = np.repeat([0.005, 0.02], 60)
    starts = np.tile(q, (2, 1)), np.tile(qd, (2, 1))
    tips = jax.jit(jax.vmap(_tip_of_free))(*starts)
    places = tips + np.tile(aside, (2, 1)) * radius[:, None]

    def motion(x, member, **options):
        q, qd, place, radius = member
        peg = fj.SpringDamper(
            fj.Point(0, *place), fj.Point(2, 1.0), stiffness=1e3 * x[3], damping=2,
            rest_length=radius * x[2], one_sided="bumper",
        )  # fmt: skip
        start = fj.State(q, qd * x[:2])
        return fj.simulate(pegs.PENDULUM, start, [0, 1.2], (peg,), **options)

    members = *starts, places, radius
    return Scenes(motion, jax.tree.map(jnp.asarray, members), lambda _: jnp.ones(4))


def _tip_of_free(q, qd):
    start, options = fj.State(q, qd), dict(adjoint=FORWARD, throw=False)
    free = fj.simulate(pegs.PENDULUM, start, [0, 0.4], **options)
    return fj.tip_position(pegs.PENDULUM, free.q[-1])


def _at_rest() -> Scenes:
    """The arms of `test_random_arms_at_rest`."""
    rng, found = np.random.default_rng(2), []
    while len(found) < 24:
        kind = rng.choice(["nothing", "damper", "PD", "friction", "stops"])
        numbers, scene = rest.held_by(kind, rng, "R" + rng.choice([*"RRP"]))
        _, rates = rest.exact(numbers, scene)
        time = float(scene[2])
        if rates.real.max() * time <= 5 and np.abs(rates).max() * time <= 3e4:
            found.append((numbers, scene))

    def motion(x, member, **options):
        numbers, scene = member
        _, whole = ravel_pytree(numbers)
        arm, forces, start = rest.changed(whole(x), scene)
        ts = jnp.stack([0.0, scene[2]])
        return fj.simulate(arm, start, ts, forces, **options)

    members = jax.tree.map(lambda *rows: jnp.stack(rows), *found)
    return Scenes(motion, members, lambda member: ravel_pytree(member[0])[0])


def _held(scenes: list[held.Held], end: float) -> Scenes:
    """Scenes of as many joints; the numbers that vary are those of the test."""

    def motion(x, member, **options):
        scene, varied = member
        numbers, of_numbers = scene.numbers()
        arm, start, forces = of_numbers(jnp.where(varied, x, numbers))
        return fj.simulate(arm, start, jnp.array([0, end]), forces, **options)

    numbers = [scene.numbers()[0] for scene in scenes]
    varied = [np.isfinite(row) & (row != 0) for row in numbers]
    members = jax.tree.map(lambda *rows: jnp.stack(rows), *zip(scenes, varied))
    return Scenes(motion, members, lambda member: member[0].numbers()[0])


def _of_elements(kind: dict[str, fj.Element]) -> Scenes:
    """All elements of a dictionary at once, on an arm that starts in four states."""
    parts, arm = tuple(kind.values()), elements.arm("RPR")
    (q, qd), sizes = elements.START, (1, -1, 0.5, -0.5)
    scenes = [held.Held(arm, fj.State(x * q, x * qd), parts) for x in sizes]
    return _held(scenes, 0.3)


def _limited_or_touching() -> Scenes:
    """The scenes of `_switching` in which a controller, a cable or a bumper acts."""
    scenes = _switching(switching.ELEMENTS, slice(2))
    of_three = lambda row: row[: 3 * len(row) // len(switching.ELEMENTS)]
    return scenes._replace(members=jax.tree.map(of_three, scenes.members))


def _held_moving() -> Scenes:
    rngs = (np.random.default_rng(1000 + seed) for seed in TWO_JOINTS)
    return _held([held.random_scene(rng, moving=True) for rng in rngs], 1.3)


def _held_starting() -> Scenes:
    """Some joints rest at the start, where derivatives may hold on one side only."""
    rngs = map(np.random.default_rng, FOUR_JOINTS)
    return _held([held.random_scene(rng) for rng in rngs], 2.0)


# Seeds of random scenes whose joints are held
TWO_JOINTS = 37, 112, 142, 243, 336, 350
FOUR_JOINTS = 4, 5, 8, 10, 12, 17, 22, 28

GROUPS: dict[str, tuple[Callable[[], Scenes], Callable[..., Rows]]] = {
    "at rest": (_at_rest, twice),
    "at rest, tangents": (_at_rest, tangents),
    "at rest, adjoint": (_at_rest, adjoint),
    "pegs": (_pegs, twice),
    "switching": (partial(_switching, switching.ELEMENTS), forward),
    "switching, tangents": (partial(_switching, switching.ELEMENTS), tangents),
    "switching, batch": (partial(_switching, switching.ELEMENTS), plain),
    "switching, twice": (_limited_or_touching, twice),
    "moving": (partial(_switching, switching.MOVING), forward),
    "plain elements": (partial(_of_elements, elements.PLAIN), forward),
    "elements with a state": (partial(_of_elements, elements.WITH_STATE), forward),
    "elements with inertia": (partial(_of_elements, elements.WITH_INERTIA), forward),
    "holding elements": (partial(_of_elements, elements.HOLDING), forward),
    "held, two joints": (_held_moving, forward),
    "held, two joints, adjoint": (_held_moving, adjoint),
    "held, four joints": (_held_starting, plain),
}


def numbers_of(group: str) -> Rows:
    """Computes a group's numbers, and by how much they change with the tolerance."""
    make, engine = GROUPS[group]
    scenes = make()

    @partial(jax.jit, **LOOPS)
    def run(members, tolerance):
        one = lambda member: engine(scenes, member, tolerance)
        if engine is plain:
            return jax.vmap(one)(members)
        return jax.lax.map(one, members)  # a batch would take all steps of all scenes

    run = partial(run, scenes.members)
    rows, *others = (
        jax.tree.map(np.asarray, run(TOLERANCE * factor)) for factor in (1, *OTHERS)
    )
    for name in [name for name in rows if name != "steps"]:
        changes = [differences(name, other, rows) for other in others]
        rows[f"{name} uncertain"] = np.max(changes, axis=0)
    return rows


def differences(name: str, new: Rows, old: Rows) -> np.ndarray:
    """Returns the largest difference of each scene, infinite where one is NaN."""
    new, old = (np.reshape(rows[name], (len(old[name]), -1)) for rows in (new, old))
    size = 1 if name == "switches" else np.maximum(abs(old).max(axis=1), 1)
    change = abs(new - old).max(axis=1) / size
    return np.where(np.isnan(change), np.inf, change)


def compared(new: Rows, old: Rows) -> Iterator[tuple[str, bool]]:
    """Yields a line on each kind of number of a group, and whether it is in bounds."""
    total, change = old["steps"].sum(), new["steps"].sum() - old["steps"].sum()
    most = max(STEPS * total, len(new["steps"]))
    yield f"steps {total}, {change / total:+.2%}", abs(change) <= most
    for name in [name for name in BOUNDS if name in old]:
        found, uncertain = differences(name, new, old), old[f"{name} uncertain"]
        bounds = np.maximum(BOUNDS[name], UNCERTAIN * uncertain)
        worst, beyond = np.argmax(found / bounds), np.flatnonzero(found > bounds)
        line = f"{name} {found.max():.1e}, in scene {worst} {found[worst]:.1e} of "
        line += f"{bounds[worst]:.1e}"
        if beyond.size:
            line += f"; beyond its bound: {beyond.tolist()}"
        yield line, not beyond.size


def main() -> None:
    parser = argparse.ArgumentParser(prog="frozen", description=__doc__)
    parser.add_argument("act", choices=["write", "compare"])
    parser.add_argument("file", type=Path)
    parser.add_argument(
        "groups", nargs="*", help=f"by default all: {', '.join(GROUPS)}"
    )
    options = parser.parse_args()
    if unknown := set(options.groups) - set(GROUPS):
        parser.error(f"groups: unknown {', '.join(sorted(unknown))}")
    kept = dict(np.load(options.file)) if options.file.exists() else {}
    good = True
    for group in options.groups or GROUPS:
        began = time.perf_counter()
        rows = numbers_of(group)
        jax.clear_caches()  # programs take memory
        print(f"{group}: {time.perf_counter() - began:.0f} s", flush=True)
        if options.act == "write":
            if not all(np.isfinite(row).all() for row in rows.values()):
                sys.exit("A motion or a derivative is not finite.")
            kept |= {f"{group}: {name}": row for name, row in rows.items()}
            np.savez(options.file, **kept)
            continue
        of_group = [name for name in kept if name.startswith(f"{group}: ")]
        old = {name.removeprefix(f"{group}: "): kept[name] for name in of_group}
        for line, fine in compared(rows, old):
            print(f"  {'' if fine else 'BEYOND '}{line}", flush=True)
            good &= fine
    sys.exit(not good)


if __name__ == "__main__":
    main()
