"""The runs of the commands: the circle, the paper's figures, all topologies.

Each run simulates, writes pictures into a folder and returns its results.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from .. import scenes
from ..analysis.tracking import saturated, tip_deviation
from ..forces.joints import JointDamper
from ..linkage.coordinates import State
from ..linkage.linkage import Linkage
from ..linkage.topology import TOPOLOGIES
from ..pictures import drawing, plotting
from ..simulation.scene import Scene
from ..simulation.simulate import simulate
from ..simulation.solution import Solution
from ..tuning.league import arm_at
from ..tuning.tuning import TuneResult, tune

_SAMPLE = 0.01  # output times [s]


class Tracking(NamedTuple):
    """Measures of how well a controlled scene tracks its circle.

    - `rms`, `largest`: tip error over the whole run [m].
    - `rms_second`, `largest_second`: tip error over the second period [m].
    - `kp`, `kd`: gains (3,); `saturated`: share of the time at the limit (3,).
    """

    rms: float
    largest: float
    rms_second: float
    largest_second: float
    kp: np.ndarray
    kd: np.ndarray
    saturated: np.ndarray


class CircleRun(NamedTuple):
    """Tracking before and after tuning, the tuning itself, and wall times [s]."""

    before: Tracking
    after: Tracking
    tuned: TuneResult
    wall_times: dict[str, float]
    pictures: list[Path]


def run_circle(
    output: Path, say: Callable[[str], None], report: Callable[[str], None]
) -> CircleRun:
    """Tracks Fig 7's circle with the paper's gains, and with tuned gains."""
    wall_times = {}

    def timed(what: str, function, *arguments, **keywords):
        say(what)
        began = time.perf_counter()
        result = jax.block_until_ready(function(*arguments, **keywords))
        wall_times[what] = time.perf_counter() - began
        return result

    scene = scenes.fig7()
    first = timed("simulate with the paper's gains", simulate_finely, scene)
    tuned = timed("tune by gradients", tune, scene, report=report)
    second = timed("simulate with the tuned gains", simulate_finely, tuned.scene)
    say("draw")
    began = time.perf_counter()
    pictures = draw_circle(output, scene, first, tuned, second)
    wall_times["draw"] = time.perf_counter() - began
    return CircleRun(
        _tracking(scene, first),
        _tracking(tuned.scene, second),
        tuned,
        wall_times,
        pictures,
    )


def simulate_finely(scene: Scene) -> Solution:
    """Simulates a scene, with output times every hundredth of a second."""
    ts = np.arange(round(float(scene.t1) / _SAMPLE) + 1) * _SAMPLE
    return simulate(scene.linkage, scene.state0, ts, scene.forces)


def _tracking(scene: Scene, solution: Solution) -> Tracking:
    controller = scene.forces[0]
    task = controller.reference
    error = np.linalg.norm(tip_deviation(scene.linkage, task, solution), axis=1)
    ts, period = np.asarray(solution.ts), abs(float(task.period))
    second = error[(period <= ts) & (ts < 2 * period)]
    share = saturated(controller, scene.linkage, solution).mean(axis=0)
    return Tracking(
        rms=float(np.sqrt(np.mean(error**2))),
        largest=float(error.max()),
        rms_second=float(np.sqrt(np.mean(second**2))),
        largest_second=float(second.max()),
        kp=np.asarray(controller.kp),
        kd=np.asarray(controller.kd),
        saturated=np.asarray(share),
    )


def draw_circle(
    output: Path, scene: Scene, first: Solution, tuned: TuneResult, second: Solution
) -> list[Path]:
    """Draws path, errors, motion and efforts of a circle before and after tuning."""
    linkage, task = scene.linkage, scene.forces[0].reference
    both = {"paper's gains": first, "tuned gains": second}
    pictures = {
        "path": plotting.tracking(linkage, task, both).figure,
        "error": plotting.tracking_error(linkage, task, both).figure,
    }
    for name, one, forces in (
        ("paper", first, scene.forces),
        ("tuned", second, tuned.scene.forces),
    ):
        pictures[f"motion-{name}"] = plotting.motion_profile(linkage, one)
        pictures[f"efforts-{name}"] = plotting.effort_profile(linkage, forces, one)
    return _save(output, {f"circle-{name}": p for name, p in pictures.items()})


def run_figures(output: Path, say: Callable[[str], None]) -> list[Path]:
    """Draws the paper's Figs 3 to 7."""
    pictures = {}
    say("Figs 3 and 4: damped triple pendulum")
    scene = scenes.fig3()
    solution = simulate_finely(scene)
    cyclograph = drawing.chrono_cyclograph(
        scene.linkage, solution, until=1.5, mass_centers=True
    )
    pictures["fig3"] = cyclograph.figure
    pictures["fig4"] = plotting.motion_profile(scene.linkage, solution)
    say("Figs 5 and 6: conservative triple pendulum")
    scene = scenes.fig5()
    solution = simulate_finely(scene)
    cyclograph = drawing.chrono_cyclograph(scene.linkage, solution, until=1.5)
    pictures["fig5"] = cyclograph.figure
    pictures["fig6-angles"] = plotting.motion_profile(scene.linkage, solution)
    pictures["fig6-energies"] = plotting.energy_profile(scene.linkage, solution)
    say("Fig 7: RPR arm under PD control")
    scene = scenes.fig7()
    solution = simulate_finely(scene)
    axes = drawing.chrono_cyclograph(scene.linkage, solution, until=0.5)
    task = scene.forces[0].reference
    plotting.tracking(scene.linkage, task, {"tip": solution}, axes)
    pictures["fig7"] = axes.figure
    return _save(output, pictures)


# The common start in chain coordinates B1, th2, B2, th3, B3, th4.
_COMMON_START = np.array([0.0, 0.6, 0.4, -0.4, 0.3, -1.3])


def topology_scenes(t1: float = 2.0) -> dict[str, Scene]:
    """Scenes of one arm in all seven topologies, at rest in the same configuration.

    The links of 1 m, 0.8 m and 0.5 m move under gravity. Only the choice of the real
    joint of each pair differs. Slides are damped more than revolute joints, as they
    would otherwise fall out of sight.
    """
    result = {}
    for topology in TOPOLOGIES:
        linkage, state0 = arm_at(topology, _COMMON_START)
        damper = JointDamper([{"R": 1.0, "P": 30.0}[joint] for joint in topology])
        result[topology] = Scene(linkage, state0, (damper,), t1)
    return result


def run_topologies(
    output: Path, say: Callable[[str], None]
) -> tuple[dict[str, tuple[Linkage, Solution]], Path]:
    """Simulates and draws all seven topologies in one compiled, batched call."""
    members = topology_scenes()
    say("simulate all seven topologies in one compiled call")
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *members.values())
    ts = np.arange(round(float(batch.t1[0]) / _SAMPLE) + 1) * _SAMPLE

    @jax.jit
    @jax.vmap
    def motions(linkage: Linkage, state0: State, forces):
        return simulate(linkage, state0, ts, forces)

    together = motions(batch.linkage, batch.state0, batch.forces)
    solutions = {
        topology: (scene.linkage, jax.tree.map(lambda leaf, i=i: leaf[i], together))
        for i, (topology, scene) in enumerate(members.items())
    }
    say("draw")
    pictures = _save(output, {"topologies": drawing.topology_grid(solutions)})
    return solutions, pictures[0]


def _save(output: Path, pictures: dict) -> list[Path]:
    output.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, figure in pictures.items():
        path = output / f"{name}.png"
        figure.savefig(path, dpi=150)
        plt.close(figure)
        paths.append(path)
    return paths
