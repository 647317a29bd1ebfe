"""The checks before a motion is computed, which compile nothing."""

import json
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.references.reference import known_assembly
from fdof_jax.references.timing import PROFILES
from fdof_jax.simulation.prescribed import agrees
from fdof_jax.simulation.simulate import check_elements

ARM = dict(
    length=[0, 1, 1, 0.3], com=[[0.5, 0]] * 3, mass=[1] * 3, inertia=[0.1] * 3
)  # fmt: skip
POINTS = [[1.2, 0.3], [1.4, 0.6], [1.1, 0.9], [0.8, 0.5]]
START = np.zeros(3)
TS = np.linspace(0, 3, 61)


def references():
    """Returns the library's references: every path with every timing that suits."""
    paths = {
        "line": fj.references.Line([1.2, -0.4], [0.9, 0.8]),
        "ellipse": fj.references.Ellipse([1.1, 0.4], [0.4, 0.2], tilt=0.3),
        "eight": fj.references.FigureEight([1.1, 0.4], [0.4, 0.2], tilt=-0.2),
        "spline": fj.references.Spline(POINTS),
        "closed spline": fj.references.Spline(POINTS, closed=True),
    }
    timings = {
        profile: fj.references.Travel(2.0, begin=0.5, profile=profile, shock=0.2)
        for profile in PROFILES
    }
    timings["laps"] = fj.references.Laps(2.0, phase=0.1)
    return {
        "circle": fj.CircleTask([1.1, 0.4], 0.3, 2.0, 0.5, 0.0),
        "move": fj.references.JointMove(START, [1, 2, 3], timings["quintic"]),
    } | {
        f"{path}, {timing}": fj.TipTask(paths[path], timings[timing])
        for path in paths
        for timing in timings
        if timing != "laps" or path not in ("line", "spline")  # which are open
    }


class Parabola(fj.references.Path):
    """A user's own path, which NumPy may be unable to evaluate."""

    middle = np.array([1.2, 0.4])

    def point(self, share):
        return jnp.stack([1.0 + 0.4 * share, 0.2 + 0.4 * share**2])


# Both routes


@pytest.mark.parametrize("name", references())
def test_numpy_gives_the_positions_that_jax_gives(name):
    arm, reference = fj.Linkage("RRR", **ARM), references()[name]
    q, root = known_assembly(reference, arm, TS)
    assert isinstance(q, np.ndarray) and np.all(root != 0)
    expected = jax.jit(jax.vmap(lambda t: reference(t, arm)[0]))(TS)
    np.testing.assert_allclose(q, expected, atol=1e-13)


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_reachable_is_the_same_for_known_and_for_traced_times(topology):
    arm = fj.Linkage(topology, locked=[0.3, -0.2, 0.4], base_angle=0.2, **ARM)
    some = 0
    for seed in range(20):
        random = np.random.default_rng(seed)
        center, (radius, phase, angle) = random.normal(size=2), random.uniform(size=3)
        circle = fj.CircleTask(center, radius, 2.0, phase, angle, (-1) ** seed)
        path = fj.references.Ellipse(center, [radius, 0.5], tilt=phase)
        for task in (
            circle,
            fj.TipTask(path, fj.references.Laps(2.0), orientation=angle),
        ):
            known, traced = (
                fj.references.reachable(arm, task, TS),
                _reachable(arm, task, TS),
            )
            np.testing.assert_array_equal(known, traced)
            some += known.any() and not known.all()
    assert some or topology.count("P") == 2  # of which none is out of reach


_reachable = jax.jit(fj.references.reachable)


def test_a_circle_that_touches_the_edge_of_the_reach_is_refused():
    """The joint velocities are infinite at the edge."""
    arm = fj.Linkage("RRR", **ARM | {"length": [0, 1, 1, 0.25]})
    task = fj.CircleTask([1.25, 0], 1.0, 2.0, 0.0, 0.0)
    with pytest.raises(ValueError, match="reference: expected a circle within"):
        task.check(arm, TS)
    assert not fj.references.reachable(arm, task, TS)[0]


# Compilations


def compiled_programs():
    """Returns two counts of compiled programs: the library's and a user's path's."""
    count = [0]

    def listen(event, duration, **details):
        count[0] += event == "/jax/core/compile/backend_compile_duration"

    jax.monitoring.register_event_duration_secs_listener(listen)
    import elements

    times = jax.device_put(TS)
    arm = fj.Linkage("RRR", **ARM)
    for topology in fj.TOPOLOGIES:
        for element in elements.ALL.values():
            model = getattr(element, "model", None)
            if model is None or topology == "RPR":
                check_elements((element,), elements.arm(topology), times)
    for reference in references().values():
        forces = (
            fj.PDController(10.0, 1.0, np.inf, reference),
            fj.simulation.PrescribedMotion((1, 3), reference),
        )
        check_elements(forces, arm, times)
        agrees(forces, 0.0, START, arm)
        fj.references.reachable(arm, reference, times)
    fj.inverse_kinematics(arm, [1.2, 0.3], 0.0)
    for scene in (
        fj.scenes.fig3(),
        fj.scenes.fig7(),
        *fj.tuning.circle_scenes().values(),
    ):
        check_elements(scene.forces, scene.linkage, times)
    library = count[0]
    for slope in (1.0, 2.0):
        own = fj.TipTask(Parabola(), fj.references.Travel(2.0 * slope))
        check_elements((fj.PDController(10.0, 1.0, 5.0, own),), arm, times)
    return library, count[0] - library


def test_the_door_compiles_nothing_but_a_user_s_path():
    """Runs in a new process, as this one may have compiled the programs already."""
    script = (
        "import json, fdof_jax; fdof_jax.configure(x64=True); import test_door;"
        "print(json.dumps(test_door.compiled_programs()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=True,
    )
    library, own = json.loads(done.stdout)
    # Some versions of JAX compile a program that converts NumPy's arguments.
    assert library == 0 and own <= 2
