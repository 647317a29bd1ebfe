"""Malformed arguments of pictures are named, and no figure is left open."""

import importlib
import sys
from functools import partial

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from test_drawing import LINKAGE, SOLUTION, made_up, make_linkage

import fdof_jax as fj
from fdof_jax import drawing, interactive, plotting

BATCH = made_up(SOLUTION.ts, jnp.stack([SOLUTION.q] * 2))
NOWHERE = made_up(SOLUTION.ts, SOLUTION.q * jnp.nan)
PAIR, PAIRS = (LINKAGE, SOLUTION), {"a": (LINKAGE, SOLUTION)}
SLIDE, TASK, PUSH = make_linkage("RPR"), fj.CircleTask(), fj.JointDamper(1.0)
FREE, CIRCLE = fj.scenes.fig5(), fj.scenes.fig7()
UNTIED = fj.PDController(1, 1, 1, lambda t, linkage: None)
OF_SCENE, OF_MOTION = r"scenes\['a'\]", r"motions\['a'\]"
OF_SOLUTION = r"solutions\['a'\]"

# The argument's name, the function, and what it is given
REFUSED = [
    ("linkage", drawing.draw_linkage, "RRR", [0, 0, 0]),
    ("q", drawing.draw_linkage, LINKAGE, [0, 0]),
    ("ax", drawing.draw_linkage, LINKAGE, [0, 0, 0], 3),
    ("solution", drawing.animate, LINKAGE, BATCH),
    ("forces", partial(drawing.animate, forces=PUSH), *PAIR),
    ("until", partial(drawing.animate, until=-1), *PAIR),
    ("max_frames", partial(drawing.animate, max_frames=0), *PAIR),
    ("fps", partial(drawing.animate, fps=0), *PAIR),
    ("speed", partial(drawing.animate, speed=-1), *PAIR),
    ("solution", drawing.chrono_cyclograph, LINKAGE, NOWHERE),
    ("every", partial(drawing.chrono_cyclograph, every=0), *PAIR),
    ("until", partial(drawing.chrono_cyclograph, until=-1), *PAIR),
    ("motions", drawing.topology_grid, {}),
    (OF_MOTION, drawing.topology_grid, {"a": SOLUTION}),
    (OF_MOTION, drawing.topology_grid, {"a": ("RRR", SOLUTION)}),
    ("configurations", partial(drawing.topology_grid, configurations=1), PAIRS),
    ("forces", partial(drawing.topology_grid, forces={"b": ()}), PAIRS),
    ("motions", drawing.animate_grid, {}),
    ("fps", partial(drawing.animate_grid, fps=-1), PAIRS),
    ("linkage", plotting.motion_profile, "RRR", SOLUTION),
    ("solution", plotting.motion_profile, LINKAGE, BATCH),
    ("absolute", partial(plotting.motion_profile, absolute="yes"), *PAIR),
    ("title", partial(plotting.motion_profile, title=3), *PAIR),
    ("linkage", plotting.energy_profile, None, SOLUTION),
    ("solution", plotting.energy_profile, LINKAGE, NOWHERE),
    ("fig", plotting.energy_profile, *PAIR, 1),
    ("linkage", plotting.effort_profile, None, (), SOLUTION),
    ("forces", plotting.effort_profile, LINKAGE, [], SOLUTION),
    ("solution", plotting.energy_stack, LINKAGE, (), NOWHERE),
    ("forces", plotting.energy_stack, LINKAGE, [], SOLUTION),
    ("task", plotting.tracking, LINKAGE, None, {"a": SOLUTION}),
    ("solutions", plotting.tracking, LINKAGE, TASK, {}),
    (OF_SOLUTION, plotting.tracking, LINKAGE, TASK, {"a": BATCH}),
    ("solutions", plotting.tracking_error, LINKAGE, TASK, SOLUTION),
    ("task", plotting.tracking_by_error, LINKAGE, None, SOLUTION),
    ("solution", plotting.tracking_by_error, LINKAGE, TASK, BATCH),
    ("scenes", interactive.sliders, {}),
    ("scenes", interactive.sliders, CIRCLE),
    (OF_SCENE, interactive.sliders, {"a": 3}),
    ("scene", interactive.sliders, {"a": FREE}),
    (OF_SCENE, interactive.sliders, {"a": CIRCLE._replace(forces=(UNTIED,))}),
]


def test_malformed_arguments_are_named():
    plt.close("all")  # figures of other tests
    for name, function, *given in REFUSED:
        with pytest.raises(ValueError, match=f"^{name}: expected"):
            function(*given)
        assert not plt.get_fignums()


def test_without_ipywidgets_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    monkeypatch.delitem(sys.modules, interactive.__name__)
    again = importlib.import_module(interactive.__name__)  # imports it on use alone
    with pytest.raises(ImportError, match=r"fdof_jax\[notebook\]"):
        again.sliders()
