"""Long runs: the energy drift of Fig 5 over 1000 s against the time spent.

Double precision follows this chaotic motion for 25 s; beyond, only the energy can be
judged. The exact energy is zero; the defect is the largest |E| [J] at a thousand output
times.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np

from . import contestants as own, peers, taylor
from .contestants import Contestant
from .measure import Case, Skipped, measure, skipped
from .problems import Problem, fig5

PROTOCOL = "drift"
TSIT5 = diffrax.Tsit5()
DOPRI8 = diffrax.Dopri8()
TABLE = (
    ("fdof_jax", own.fdof_jax, (1e-11, 1e-12, 1e-13)),
    ("fdof_jax, fixed steps", partial(own.fdof_jax, fixed=True), (5e-3, 2.5e-3)),
    (
        "fdof_jax Dopri8, fixed steps",
        partial(own.fdof_jax, solver=DOPRI8, fixed=True),
        (2.5e-3,),
    ),
    ("fdof_jax Tsit5", partial(own.fdof_jax, solver=TSIT5), (1e-11,)),
    (
        "fdof_jax Tsit5, fixed steps",
        partial(own.fdof_jax, solver=TSIT5, fixed=True),
        (1e-3,),
    ),
    ("C order 8", partial(peers.native, method="order 8"), (5e-3, 2.5e-3, 1.25e-3)),
    ("heyoka", taylor.heyoka, (1e-9, 1e-12, 1e-15)),
    ("MuJoCo RK4", partial(peers.mujoco, integrator="RK4"), (5e-3, 2.5e-3)),
)


def _judge(problem: Problem, contestant: Contestant, result: Any) -> dict:
    motion = contestant.motion(result)
    q, qd = jnp.asarray(motion.q), jnp.asarray(motion.qd)
    defect = float(jnp.max(jnp.abs(own.energy(problem.linkage, q, qd))))
    # A tenth of a joule counts as a failure here, like a tenth of a radian elsewhere.
    return {"error": defect, "energy_defect": defect}


def run(quick: bool) -> Iterator[dict]:
    horizon = 20 if quick else 1000
    ts = np.linspace(0, horizon, horizon + 1)
    problem = fig5()._replace(name=f"fig5-{horizon}s", ts=ts)
    prepared = []
    for name, make, settings in TABLE:
        long = {"long": True} if name.startswith("fdof_jax") else {}
        try:
            contestant = make(problem, **long)
        except Skipped as reason:
            yield skipped(PROTOCOL, name, str(reason))
            continue
        judge = partial(_judge, problem, contestant)
        prepared += [
            Case(name, s, partial(contestant.run, s), judge, contestant.kind)
            for s in settings
        ]
    yield from measure(
        PROTOCOL,
        prepared,
        budget=5 if quick else 30,
        rounds=5,
        ratio_to="fdof_jax",
        problem=problem.name,
        horizon=horizon,
    )
