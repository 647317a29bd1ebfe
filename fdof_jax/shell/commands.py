"""The commands of `fdof-jax`, which print results and return the files they write."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.figure import Figure

from .. import scenes
from ..analysis.tracking import tip_deviation
from ..base.checks import real_array
from ..base.configuration import configure
from ..data.files import save
from ..forces.joints import JointDamper
from ..linkage.linkage import Linkage
from ..pictures import drawing, plotting
from ..pictures.axes import figure_legend
from ..pictures.elements import COMMANDED
from ..references.circle import CircleTask
from ..simulation.scene import Scene
from ..simulation.simulate import simulate
from ..simulation.solution import Solution
from ..tuning.ensembles import perturbed
from ..tuning.league import circle_scenes, league_table
from ..tuning.losses import Tracking, tip_errors
from ..tuning.tuning import tune, tune_each


def run(command: str, output: Path, options: dict[str, Any]) -> list[Path]:
    """Runs a command in a process of its own; its files go into the folder `output`.

    **Raises:** ValueError for options that the library rejects.
    """
    matplotlib.use("agg")  # pictures are written, never shown
    configure(x64=True)
    return _COMMANDS[command](output, **options)


def _figures(output: Path) -> list[Path]:
    """Reproduces the paper's Figs 3 to 7."""
    _say("Figs 3 and 4: damped triple pendulum")
    arm, motion = scenes.fig3().linkage, _motion(scenes.fig3())
    fig3 = drawing.chrono_cyclograph(arm, motion, until=1.5, mass_centers=True)
    pictures = {"fig3": fig3.figure, "fig4": plotting.motion_profile(arm, motion)}
    _say("Figs 5 and 6: conservative triple pendulum")
    arm, motion = scenes.fig5().linkage, _motion(scenes.fig5())
    pictures["fig5"] = drawing.chrono_cyclograph(arm, motion, until=1.5).figure
    pictures["fig6-angles"] = plotting.motion_profile(arm, motion)
    pictures["fig6-energies"] = plotting.energy_profile(arm, motion)
    _say("Fig 7: RPR arm under PD control")
    arm, _, (controller,), _ = scenes.fig7()
    motion = _motion(scenes.fig7())
    axes = drawing.chrono_cyclograph(arm, motion, until=0.5)
    plotting.tracking(arm, controller.reference, {"tip": motion}, axes)
    return _saved(output, pictures | {"fig7": axes.figure})


def _topologies(output: Path) -> list[Path]:
    """Simulates the fall of one arm in all seven topologies, by one program."""
    _say("simulate all seven topologies by one compiled program")
    motions = {}
    for topology, scene in circle_scenes().items():
        # Slides, damped more, do not fall out of sight.
        damper = JointDamper([{"R": 1.0, "P": 30.0}[joint] for joint in topology])
        solution = _motion(scene._replace(forces=(damper,), t1=2.0))
        motions[topology] = scene.linkage, solution
        print(f"  {topology}: {int(solution.stats['num_steps'])} steps")
    return _saved(output, {"topologies": drawing.topology_grid(motions)})


def _league(output: Path) -> list[Path]:
    """Tunes the gains of all seven topologies on one circle."""
    _say("tune all seven topologies in one compiled program")
    results = tune_each(circle_scenes(), report=print)
    print(f"\n{league_table(results)}")
    save(output / "league.json", results)
    return [output / "league.json"]


def _tune(output: Path, **options: Any) -> list[Path]:
    """Tracks a circle with Fig 7's arm for two turns, tunes the gains, tracks it again.

    **Arguments:** `options`: keywords of `CircleTask`, `perturbed` and `tune`, and the
    `price` of effort.
    """

    def given(names: str) -> dict[str, Any]:
        return {name: options[name] for name in names.split() if name in options}

    task = CircleTask(**given("center radius period"))
    scene = scenes.fig7()
    controller = eqx.tree_at(lambda c: c.reference, scene.forces[0], task)
    scene = scene._replace(forces=(controller,), t1=2 * abs(float(task.period)))
    variations = given("members payload start_offset speed link_error")
    ensemble = None
    if variations:
        ensemble = perturbed(scene, **{"members": 16} | variations)
    loss = tip_errors
    if "price" in options:
        loss = Tracking(real_array("price", options["price"], (), minimum=0))
    _say("tune the gains (compiling first)")
    tuned = tune(
        scene,
        loss=loss,
        ensemble=ensemble,
        report=print,
        **given("factor over method starts seed max_steps"),
    )
    _say("simulate and draw")
    motions, pictures, errors = {}, {}, []
    for name, (arm, _, forces, t1) in (("paper", scene), ("tuned", tuned.scene)):
        motion = motions[f"{name} gains"] = _motion(scene._replace(forces=forces))
        pictures[f"circle-motion-{name}"] = plotting.motion_profile(arm, motion)
        efforts = plotting.effort_profile(arm, forces, motion)
        pictures[f"circle-efforts-{name}"] = efforts
        late = (t1 / 2 <= motion.ts) & (motion.ts < t1)
        deviation = np.asarray(tip_deviation(arm, task, motion))[late]
        errors.append(1e3 * np.sqrt((deviation**2).sum(axis=1).mean()))
    still, moving = _arms(scene.linkage, task, motions)
    pictures = {"circle-arm": still} | pictures
    path = plotting.tracking(scene.linkage, task, motions)
    error = plotting.tracking_error(scene.linkage, task, motions)
    pictures |= {"circle-path": path.figure, "circle-error": error.figure}
    print(f"\n{tuned}")
    print("rms tip error in the second turn [mm]: {:.5g} to {:.5g}".format(*errors))
    files = _saved(output, pictures)
    files.insert(1, output / "circle-arm.gif")
    moving.save(files[1], dpi=80)
    plt.close("all")
    save(output / "tuned.json", tuned)
    return [*files, output / "tuned.json"]


def _arms(
    arm: Linkage, task: CircleTask, motions: dict[str, Solution]
) -> tuple[Figure, FuncAnimation]:
    """The arm on the circle with each set of gains: second turn, still and moving."""
    period = abs(float(task.period))
    turns = {}
    for name, motion in motions.items():
        later = np.asarray(motion.ts) >= period
        ts, q, qd = (a[later] for a in (motion.ts - period, motion.q, motion.qd))
        turns[name] = arm, dataclasses.replace(motion, ts=ts, q=q, qd=qd)
    still, shown = (
        plt.figure(figsize=(7.4, 3.4), layout="constrained") for _ in range(2)
    )
    drawing.topology_grid(turns, still, configurations=6)
    moving = drawing.animate_grid(turns, shown, fps=12.5, speed=period / 5)
    circle = np.stack([task.tip(t) for t in np.linspace(0, period, 101)])
    for figure in (still, shown):
        for ax in figure.axes:
            ax.plot(*circle.T, label="commanded", zorder=1, **COMMANDED)
        figure_legend(figure)
    shown.draw_without_rendering()
    shown.set_layout_engine("none")  # a layout per frame takes half the time
    return still, moving


_COMMANDS: dict[str, Callable[..., list[Path]]] = {
    "circle": _tune,
    "figures": _figures,
    "topologies": _topologies,
    "league": _league,
    "tune": _tune,
}


def _times(scene: Scene) -> np.ndarray:
    """Output times every hundredth of a second."""
    return np.arange(round(float(scene.t1) / 0.01) + 1) * 0.01


def _motion(scene: Scene) -> Solution:
    return simulate(scene.linkage, scene.state0, _times(scene), scene.forces)


def _say(text: str) -> None:
    print(f"{text} ...", flush=True)


def _saved(output: Path, pictures: dict[str, Any]) -> list[Path]:
    """Writes figures, by name, into the folder."""
    for name, figure in pictures.items():
        figure.savefig(output / f"{name}.png", dpi=150)
        plt.close(figure)
    return [output / f"{name}.png" for name in pictures]
