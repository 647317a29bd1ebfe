"""Makes arms.gif, the picture at the top of the README: `python docs/arms.py`."""

from pathlib import Path

import matplotlib

matplotlib.use("agg")  # the picture is written, never shown

import matplotlib.pyplot as plt
import numpy as np

import fdof_jax as fj
from fdof_jax import drawing
from fdof_jax.pictures.axes import figure_legend
from fdof_jax.pictures.elements import COMMANDED

fj.configure(x64=True)
ts = np.linspace(0, 5, 501)  # one turn of the circle

scene = fj.tune(fj.scenes.fig7()).scene
circling = fj.simulate(scene.linkage, scene.state0, ts, scene.forces)
pendulum = fj.scenes.fig5()
fall = fj.simulate(pendulum.linkage, pendulum.state0, ts)

figure = plt.figure(figsize=(7.2, 3.3), layout="constrained")
animation = drawing.animate_grid(
    {
        "RPR: gains tuned by gradients": (scene.linkage, circling),
        "RRR: a triple pendulum falls": (pendulum.linkage, fall),
    },
    figure,
    fps=20,
)
circle = np.asarray([scene.forces[0].reference.tip(t) for t in ts[::5]])
figure.axes[0].plot(*circle.T, zorder=1, label="commanded", **COMMANDED)
figure_legend(figure)
animation.save(Path(__file__).with_suffix(".gif"), dpi=80)
