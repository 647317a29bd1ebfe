"""Numbers that a change of structure must not change: `python -m benchmarks.frozen`.

Prints what differs from `results/frozen.json`, and fails if anything does; with
`--write`, records today's. Names of parts choose some of them. The numbers are the
public signatures, the cost of the paper's scenes (flops of their programs before XLA,
traces of an element, steps), the motions of the hard cases, and 441 random motions
through switches.
"""

import argparse
import inspect
import json
import sys
from pathlib import Path
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj

fj.configure(x64=True)  # before what the scenes compute at import
# ruff: noqa: E402
from .hard_engines import Refused, fdof_jax
from .hard_scenes import motions

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from switching_scenes import ELEMENTS, MOVING, random_members, random_scene

FILE = Path(__file__).parent / "results" / "frozen.json"
ROOMS = (
    "paper",
    "forces",
    "control",
    "references",
    "simulation",
    "analysis",
    "tuning",
    "identification",
    "data",
)
NEAR = 1e-8  # of positions and derivatives; hard cases are judged by their errors
MANY_STEPS = 1.02  # so many times the steps that a hard case took


def signatures() -> dict[str, str]:
    """Returns the signature of each public name, and the methods of classes."""
    told = {}
    for room in ("", *ROOMS):
        place = getattr(fj, room) if room else fj
        for name in sorted(place.__all__):
            value = getattr(place, name)
            if not callable(value):
                continue
            key = f"{room}.{name}" if room else name
            parameters = inspect.signature(value).parameters.values()
            told[key] = ", ".join(_shown(parameter) for parameter in parameters)
            if isinstance(value, type):
                own = [n for n in vars(value) if not n.startswith("_")]
                told[key] += "; " + " ".join(sorted(own))
    return told


def _shown(parameter: inspect.Parameter) -> str:
    optional = parameter.default is not parameter.empty
    marks = {parameter.VAR_KEYWORD: "**", parameter.KEYWORD_ONLY: "*, "}
    return marks.get(parameter.kind, "") + parameter.name + "=" * optional


class Counted(fj.Element):
    """A damper that counts how often it is traced."""

    coefficient: fj.Values = fj.field((), unit="N m s/rad")
    traces = [0]

    def __call__(self, t, q, qd, linkage):
        self.traces[0] += 1
        return -self.coefficient * qd


def traces() -> dict[str, int]:
    """Returns how often an element is traced for a motion and its derivatives."""
    arm, start, _, _ = fj.scenes.fig5()
    end = lambda c, **more: jnp.sum(
        fj.simulate(arm, start, [0, 0.1], (Counted(c),), **more).q[-1]
    )
    ways = {
        "plain": lambda: end(0.1),
        "grad": lambda: jax.grad(end)(0.1),
        "jacfwd": lambda: jax.jacfwd(lambda c: end(c, adjoint=diffrax.ForwardMode()))(
            0.1
        ),
        "vmap": lambda: jax.vmap(end)(jnp.array([0.1, 0.2])),
        "sweep": lambda: fj.sweep(
            arm,
            fj.State(start.q + jnp.zeros((4, 1)), start.qd + jnp.zeros((4, 1))),
            [0, 0.1],
            (Counted(0.1),),
        ),
    }
    counts = {}
    for name, run in ways.items():
        jax.clear_caches()
        Counted.traces[0] = 0
        run()
        counts[name] = Counted.traces[0]
    return counts


def figures() -> dict[str, dict[str, Any]]:
    """Returns steps, flops and ends of the paper's scenes and their derivatives."""
    return {
        name: _figure(getattr(fj.scenes, name)()) for name in ("fig3", "fig5", "fig7")
    }


def _figure(scene: fj.Scene) -> dict[str, Any]:
    arm, start, forces, t1 = scene
    t1 = min(t1, 4.0)  # before Fig 5's chaos enlarges rounding

    def move(q0):
        return fj.simulate(arm, fj.State(q0, start.qd), [0, t1], forces)

    def end(q0):
        motion = move(q0)
        return jnp.sum(motion.q[-1]), motion.stats["num_steps"]

    motion = move(start.q)
    slope, steps = jax.jit(jax.grad(end, has_aux=True))(start.q)
    return {
        "steps": int(motion.stats["num_steps"]),
        "accepted": int(motion.stats["num_accepted_steps"]),
        "flops": float(jax.jit(move).lower(start.q).cost_analysis()["flops"]),
        "end": motion.q[-1].tolist(),
        "steps of the gradient": int(steps),
        "gradient": slope.tolist(),
    }


def hard() -> dict[str, dict[str, Any]]:
    """Returns errors and steps of the hard cases."""
    told = {}
    for scene in motions():
        key = f"{scene.number} {scene.name}"
        key += ", derivative" if scene.derivative else ""
        try:
            run = fdof_jax(scene)()
        except Refused as refused:
            told[key] = {"refused": str(refused)}
            continue
        error = float(scene.judge(np.asarray(run.q), np.asarray(run.qd)))
        told[key] = {"within bounds": bool(error <= scene.bound), "steps": run.steps}
    return told


def switching() -> dict[str, dict[str, Any]]:
    """Returns steps, switches and ends of random motions."""
    told = {}
    for elements in (ELEMENTS, MOVING):

        def end(member):
            arm, start, forces, t1 = random_scene(1.0, 1.0, 0.0, member)
            motion = fj.simulate(
                arm, start, jnp.array([0, t1]), forces, rtol=1e-11, atol=1e-11,
                throw=False,
            )  # fmt: skip
            good = motion.result == diffrax.RESULTS.successful
            stats = motion.stats
            return motion.q[-1], stats["num_steps"], stats["num_switches"], good

        members = random_members(elements)
        run = jax.jit(lambda m: jax.lax.map(end, m))
        q, steps, switches, good = run(members)
        told[", ".join(elements)] = {
            "steps": steps.tolist(),
            "switches": switches.tolist(),
            "successful": int(good.sum()),
            "end": q.tolist(),
        }
    return told


def differences(old: Any, new: Any, path: str = "") -> list[str]:
    """Returns lines that name where two records differ."""
    if isinstance(old, dict) and isinstance(new, dict):
        lines = []
        for key in {**old, **new}:
            where = f"{path}/{key}"
            if key not in old or key not in new:
                lines.append(f"{where}: {'gone' if key in old else 'new'}")
            else:
                lines += differences(old[key], new[key], where)
        return lines
    if "hard" in path and path.endswith("/steps") and None not in (old, new):
        return [f"{path}: {old} -> {new}"] if new > MANY_STEPS * old else []
    if isinstance(old, list):
        apart = np.abs(np.array(old) - np.array(new))
        if path.endswith(("end", "gradient")):
            apart = apart / max(1, np.abs(old).max()) > NEAR
        count = np.count_nonzero(apart)
        return [f"{path}: {count} of {apart.size} differ"] if count else []
    return [] if old == new else [f"{path}: {old} -> {new}"]


def main() -> None:
    parser = argparse.ArgumentParser(prog="benchmarks.frozen", description=__doc__)
    parser.add_argument("--write", action="store_true", help="record today's numbers")
    parts = signatures, traces, figures, hard, switching
    by_name = {part.__name__: part for part in parts}
    parser.add_argument("parts", nargs="*", metavar="part", help=", ".join(by_name))
    options = parser.parse_args()
    record = {name: by_name[name]() for name in options.parts or by_name}
    old = json.loads(FILE.read_text()) if FILE.exists() else {}
    if options.write:
        FILE.write_text(json.dumps(old | record, indent=1) + "\n")
        return
    lines = differences({name: old[name] for name in record}, record)
    print("\n".join(lines) or "nothing differs")
    sys.exit(bool(lines))


if __name__ == "__main__":
    main()
