"""The same circle for all seven topologies, and a table of their tuned errors."""

from collections.abc import Mapping

import numpy as np

from ..base.checks import refusal
from ..control.pd import PDController
from ..linkage.coordinates import State
from ..linkage.linkage import Linkage
from ..linkage.topology import TOPOLOGIES
from ..paper import from_chain
from ..references.task import CircleTask
from ..simulation.scene import Scene
from .result import TuneResult, mean_effort

# The common start in chain coordinates B1, th2, B2, th3, B3, th4. From here every
# topology follows the circle away from its singularities.
_START = np.array([0.0, 1.0, -0.1, -1.0, 0.7, 0.8])
_BASE = np.pi / 2  # a slide on the ground is level
_CENTER = [1.99, 0.95]
# The assembly (of two) that each arm starts in.
_BRANCH = dict(zip(TOPOLOGIES, (-1, 1, -1, -1, 1, 1, 1)))
_KP, _KD = {"R": 500.0, "P": 2000.0}, {"R": 50.0, "P": 200.0}


def arm_at(topology: str, x: np.ndarray) -> tuple[Linkage, State]:
    """An arm with links of 1 m, 0.8 m and 0.5 m, at rest at chain coordinates `x`."""
    locked, state0 = from_chain(topology, x, np.zeros(6), base_angle=_BASE)
    linkage = Linkage(
        topology,
        length=[0.3, 1.0, 0.8, 0.5],
        com=[[0.5, 0], [0.4, 0], [0.25, 0]],
        mass=[2, 1.5, 1],
        inertia=[0.2, 0.1, 0.05],
        locked=locked,
        base_angle=_BASE,
    )
    return linkage, state0


def circle_scenes() -> dict[str, Scene]:
    """The same circle for an arm of each topology, under PD control and gravity.

    All arms have links of 1 m, 0.8 m and 0.5 m with masses of 2 kg, 1.5 kg and 1 kg.
    They start at rest in the same configuration, with their tip 5 cm inside the circle
    of 0.25 m radius, and keep the angle of their last link. Only the choice of the real
    joint of each pair differs. All joints of a kind have the same gains and limits
    (150 N m or N).

    >>> import fdof_jax as fj
    >>> scenes = fj.tuning.circle_scenes()
    >>> starts = [fj.tip_position(s.linkage, s.state0.q) for s in scenes.values()]
    >>> starts[0].tolist(), starts[-1].tolist()  # the same for all
    ([1.994, 1.151], [1.994, 1.151])
    """
    found = {}
    for topology in TOPOLOGIES:
        linkage, state0 = arm_at(topology, _START)
        task = CircleTask(
            center=_CENTER,
            radius=0.25,
            period=4.0,
            phase=np.pi / 2,
            orientation=_START[5],
            branch=_BRANCH[topology],
        )
        kp, kd = ([of[kind] for kind in topology] for of in (_KP, _KD))
        controller = PDController(kp, kd, 150.0, task)
        found[topology] = Scene(linkage, state0, (controller,), 4.0)
    return found


def league_table(results: Mapping[str, TuneResult]) -> str:
    """A table of tip errors and efforts before and after tuning, best first.

    **Arguments:** `results`: by name, for instance those of `tune_each`.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> scenes = fj.tuning.circle_scenes()
    >>> pair = {name: scenes[name]._replace(t1=1.0) for name in ("PPR", "RRR")}
    >>> print(fj.tuning.league_table(fj.tuning.tune_each(pair, max_steps=2)))
           rms tip error [mm]     effort [% of limit]        gains
               start       tuned       start       tuned at bounds
    PPR         15.2       7.671       6.762       14.51       2/6
    RRR        147.9       29.32          13       13.15       6/6
    """
    held = isinstance(results, Mapping) and len(results) > 0
    if not held or not all(isinstance(r, TuneResult) for r in results.values()):
        raise refusal("results", "a TuneResult for each name", results)
    rows = [
        f"{'':4}{'rms tip error [mm]':^24}{'effort [% of limit]':^24}{'gains':>10}",
        f"{'':4}" + 2 * f"{'start':>12}{'tuned':>12}" + f"{'at bounds':>10}",
    ]
    for name, result in sorted(results.items(), key=lambda item: item[1].tip_error):
        first = result.histories[0]
        at_start = mean_effort(result.scene.linkage, first.effort[0])
        error = first.tip_error[0], result.tip_error
        cells = *(1e3 * e for e in error), 1e2 * at_start, 1e2 * result.effort
        rows.append(
            f"{name:4}"
            + "".join(f"{cell:12.4g}" for cell in cells)
            + f"{result.at_bound.sum():8d}/{result.tuned_gains}"
        )
    return "\n".join(rows)
