"""Functions of scenes, motions and results name the argument that is wrong."""

import jax
import numpy as np
import pytest
from sweep_batch import TS, run, successful

import fdof_jax as fj
from fdof_jax import identification, references, scenes, tuning
from fdof_jax.batches import chunks

FIG7 = scenes.fig7()
MOTION = fj.Solution(TS, np.zeros((7, 3)), np.zeros((7, 3)), {}, None)
OTHER = fj.Solution(TS, np.zeros((7, 2)), np.zeros((7, 2)), {}, None)
STANDING = fj.PDController(1.0, 1.0, 1.0, lambda t, linkage: (np.zeros(3),) * 2)
PATH = references.Line([0, 0], [1, 1])


def refused(name, call, *arguments):
    with pytest.raises(ValueError, match=rf"(?s)^{name}: expected .*, got "):
        call(*arguments)


@pytest.mark.parametrize("call", [identification.link_ends, tuning.tip_errors])
def test_scenes_and_motions(call):
    refused("scene", call, FIG7.linkage, MOTION)
    refused("scene", call, MOTION, FIG7)
    refused("solution", call, FIG7, MOTION.q)
    refused("solution", call, FIG7, OTHER)


def test_errors_of_a_tip_need_a_task():
    standing = FIG7._replace(forces=(STANDING,))
    refused("scene", tuning.tip_errors, standing, MOTION)


@pytest.mark.parametrize("results", [None, {}, [1], {"RRR": FIG7}], ids=type)
def test_results_of_a_league(results):
    refused("results", tuning.league_table, results)


@pytest.mark.parametrize("reference", [None, PATH, STANDING, references.Laps(1.0)])
def test_references_within_reach(reference):
    refused("reference", references.reachable, FIG7.linkage, reference, TS)


def test_a_reference_that_returns_something_else():
    nothing = lambda t, linkage: None
    refused("reference", references.reachable, FIG7.linkage, nothing, TS)


def test_too_many_members():
    refused("members", tuning.perturbed, FIG7, 10**30)


@pytest.mark.parametrize(
    "q", [None, "x", [[1], [1, 2]], [0, 0], np.ma.masked_less([-1, 0, 0], 0)], ids=str
)
def test_efforts_that_hold_an_arm(q):
    refused("q", fj.analysis.holding_efforts, FIG7.linkage, q)


def test_states_of_no_elements():
    """A number has the shape (), which is also what holds no states."""
    simulate = lambda own0: fj.simulate(FIG7.linkage, FIG7.state0, TS, own0=own0)
    refused("own0", simulate, 0.0)


def test_too_many_steps():
    simulate = lambda n: fj.simulate(FIG7.linkage, FIG7.state0, TS, max_steps=n)
    refused("max_steps", simulate, 10**30)


def test_recordings_of_unlike_lengths():
    fit = identification.fit_each
    refused("observed", fit, lambda p: FIG7, {"a": 1.0}, TS, [[1], [1, 2]])


def test_no_members():
    """`vmap` over no members has nothing to raise."""
    linkage, state0, *_ = scenes.fig5()
    motion = lambda q: fj.simulate(linkage, state0._replace(q=q), TS)
    solution = jax.eval_shape(jax.vmap(motion), np.zeros((0, 3)))
    assert solution.q.shape == (0, len(TS), 3)


@pytest.fixture
def guarded():
    """Lets no array reach or leave JAX unasked, in any thread."""
    before = jax.config.jax_transfer_guard
    jax.config.update("jax_transfer_guard", "disallow")
    yield
    jax.config.update("jax_transfer_guard", before)


def test_under_a_transfer_guard(batch, guarded, monkeypatch):
    linkage, state0, *_ = scenes.fig5()
    monkeypatch.setattr(chunks, "_cores", lambda: 2)
    solution = run(batch)
    motion = fj.simulate(linkage, state0, TS)
    with jax.transfer_guard("allow"):
        assert successful(solution).all() and successful(motion)


@pytest.mark.parametrize("name", ["rtol", "atol"])
def test_derivatives_with_respect_to_a_tolerance(name):
    linkage, state0, *_ = scenes.fig5()
    end = lambda x: fj.simulate(linkage, state0, TS, **{name: x}).q[-1, 0]
    with pytest.raises(RuntimeError, match=name):
        jax.eval_shape(jax.grad(end), 1e-6)
