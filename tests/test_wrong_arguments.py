"""Functions of scenes, motions and results name the argument that is wrong."""

import jax
import numpy as np
import pytest
from sweep_batch import TS, run, successful

import fdof_jax as fj
from fdof_jax import identification, references, scenes, tuning
from fdof_jax.batches import devices

FIG7 = scenes.fig7()
MOTION = fj.Solution(TS, np.zeros((7, 3)), np.zeros((7, 3)), {}, None)
OTHER = fj.Solution(TS, np.zeros((7, 2)), np.zeros((7, 2)), {}, None)
STANDING = fj.PDController(1.0, 1.0, 1.0, lambda t, linkage: (np.zeros(3),) * 2)
PATH = references.Line([0, 0], [1, 1])
NOTHING = lambda t, linkage: None


def end(**options):
    return fj.simulate(FIG7.linkage, FIG7.state0, TS, **options)


HOLDING = fj.analysis.holding_efforts
RECORDINGS = lambda p: FIG7, {"a": 1.0}, TS, [[1], [1, 2]]  # of unlike lengths
MASKED = np.ma.masked_less([-1, 0, 0], 0)


@pytest.mark.parametrize(
    "name, call, cases",
    [
        *(
            case
            for call in (identification.link_ends, tuning.tip_errors)
            for case in (
                ("scene", call, [(FIG7.linkage, MOTION), (MOTION, FIG7)]),
                ("solution", call, [(FIG7, MOTION.q), (FIG7, OTHER)]),
            )
        ),
        # Errors of a tip need a task.
        ("scene", tuning.tip_errors, [(FIG7._replace(forces=(STANDING,)), MOTION)]),
        (
            "reference",
            references.reachable,
            [
                (FIG7.linkage, reference, TS)
                for reference in (None, PATH, STANDING, references.Laps(1.0), NOTHING)
            ],
        ),
        (
            "task",
            references.reach_margin,
            [(FIG7.linkage, task, TS) for task in (None, PATH, STANDING)],
        ),
        (
            "q",
            HOLDING,
            [(FIG7.linkage, q) for q in (None, "x", [[1], [1, 2]], [0, 0], MASKED)],
        ),
        # A number has the shape (), which is also what holds no states.
        ("own0", lambda own0: end(own0=own0), [(0.0,)]),
        ("max_steps", lambda most: end(max_steps=most), [(10**30,)]),
        ("observed", identification.fit_each, [RECORDINGS]),
    ],
)
def test_messages_name_the_argument(name, call, cases):
    for arguments in cases:
        with pytest.raises(ValueError, match=rf"(?s)^{name}: expected .*, got "):
            call(*arguments)


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
    monkeypatch.setattr(devices, "cores", lambda: 2)
    solution = run(batch)
    motion = fj.simulate(linkage, state0, TS)
    with jax.transfer_guard("allow"):
        assert successful(solution).all() and successful(motion)


@pytest.mark.parametrize("name", ["rtol", "atol"])
def test_derivatives_with_respect_to_a_tolerance(name):
    linkage, state0, *_ = scenes.fig5()
    last = lambda x: fj.simulate(linkage, state0, TS, **{name: x}).q[-1, 0]
    with pytest.raises(RuntimeError, match=name):
        jax.eval_shape(jax.grad(last), 1e-6)
