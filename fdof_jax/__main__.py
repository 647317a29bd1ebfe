"""The command line: `fdof-jax` or `python -m fdof_jax`."""

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np

from . import (
    JointDamper,
    Scene,
    Solution,
    __version__,
    configure,
    drawing,
    plotting,
    scenes,
    simulate,
)
from .checks import refusal


def main(arguments: list[str] | None = None) -> None:
    """Parses the command line, and writes the pictures of the command."""
    parser = argparse.ArgumentParser(
        prog="fdof-jax",
        description="Dynamics of planar open-chain linkages. The commands write "
        "pictures; all else is done in Python, where `help(fdof_jax)` begins.",
    )
    parser.add_argument("--version", action="version", version=__version__)
    parser.add_argument(
        "command",
        nargs="?",
        choices=_COMMANDS,
        help="figures: the paper's Figs 3 to 7; topologies: the fall of one arm in all "
        "seven topologies, by one compiled program",
    )
    parser.add_argument(
        "--output",
        metavar="FOLDER",
        default="fdof-output",
        help="where to write the pictures; %(default)s by default",
    )
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help()
        return
    output = Path(options.output)
    try:  # before anything is computed
        output.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=output).close()
    except OSError as error:
        expected = f"a folder that can be written ({error.strerror})"
        parser.error(str(refusal("--output", expected, options.output)))
    matplotlib.use("agg")  # pictures are written, never shown
    configure(x64=True)
    for name, figure in _COMMANDS[options.command]():
        figure.suptitle(_TITLES[name], x=0.01, ha="left", weight="bold", size="medium")
        figure.savefig(output / f"{name}.png", dpi=250)
        plt.close(figure)
        print(output / f"{name}.png", flush=True)
    first = (output / f"{name}.png" for name in _FIRST[options.command])
    print("Open first:", *first)


def _figures() -> Iterator[tuple[str, Any]]:
    """Reproduces the paper's Figs 3 to 7, by name."""
    arm, motion = scenes.fig3().linkage, _motion(scenes.fig3())
    axes = drawing.chrono_cyclograph(arm, motion, until=1.5, mass_centers=True)
    yield "fig3", axes.figure
    yield "fig4", plotting.motion_profile(arm, motion, absolute=True)
    arm, motion = scenes.fig5().linkage, _motion(scenes.fig5())
    yield ("fig5", drawing.chrono_cyclograph(arm, motion, until=1.5).figure)
    yield "fig6-angles", plotting.motion_profile(arm, motion, absolute=True)
    yield "fig6-energies", plotting.energy_profile(arm, motion)
    arm, _, (controller,), _ = scenes.fig7()
    motion = _motion(scenes.fig7())
    _, axes = plt.subplots(figsize=(6.4, 4.4), layout="compressed")
    plotting.tracking(arm, controller.reference, {"tip": motion}, axes)
    drawing.chrono_cyclograph(arm, motion, axes, every=0.25, until=0.5)
    yield "fig7", axes.figure


def _topologies() -> Iterator[tuple[str, Any]]:
    """Draws the fall of one arm in all seven topologies, simulated by one program."""
    motions = {}
    for topology, scene in scenes.circle_scenes().items():
        # Slides, damped more, do not fall out of sight.
        damper = JointDamper([{"R": 1.0, "P": 30.0}[joint] for joint in topology])
        motion = _motion(scene._replace(forces=(damper,), t1=2.0))
        motions[topology] = scene.linkage, motion
    yield "topologies", drawing.topology_grid(motions)


def _motion(scene: Scene) -> Solution:
    """Simulates a scene, with output times every hundredth of a second."""
    ts = np.arange(round(float(scene.t1) / 0.01) + 1) * 0.01
    return simulate(scene, ts)


_TITLES = {
    "fig3": "A damped triple pendulum, released level, swings down",
    "fig4": "Damping brings the triple pendulum to rest in a few swings",
    "fig5": "An undamped triple pendulum swings through to the other side",
    "fig6-angles": "The undamped links swing on without a period",
    "fig6-energies": "The links exchange energy; the total stays constant",
    "fig7": "Under PD control the arm sags, and its tip follows the circle too low",
    "topologies": "One arm falls in all seven topologies",
}
_COMMANDS = {"figures": _figures, "topologies": _topologies}
_FIRST = {"figures": ("fig3", "fig7"), "topologies": ("topologies",)}

if __name__ == "__main__":
    main()
