"""Malformed arguments of pictures are named, and no figure is left open."""

from functools import partial

import jax.numpy as jnp
import matplotlib.pyplot as plt
import pytest
from test_drawing import LINKAGE, SOLUTION, made_up

import fdof_jax as fj
from fdof_jax import drawing, plotting

BATCH = made_up(SOLUTION.ts, jnp.stack([SOLUTION.q] * 2))
NOWHERE = made_up(SOLUTION.ts, SOLUTION.q * jnp.nan)
PAIR, PAIRS = (LINKAGE, SOLUTION), {"a": (LINKAGE, SOLUTION)}
TASK, PUSH = fj.CircleTask(), fj.JointDamper(1.0)
OF_MOTION = r"motions\['a'\]"
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
]


def test_malformed_arguments_are_named():
    plt.close("all")  # figures of other tests
    for name, function, *given in REFUSED:
        with pytest.raises(ValueError, match=f"^{name}: expected"):
            function(*given)
        assert not plt.get_fignums()
