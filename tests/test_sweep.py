"""A sweep gives what jax.vmap(simulate) gives, member by member."""

import importlib
import os
import socket
import subprocess
import sys
from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_linkage

import fdof_jax as fj

# The package's attribute of this name is the function.
module = importlib.import_module("fdof_jax.sweep")

# Compilations dominate: nearly all tests share these shapes and settings.
TS = np.linspace(0, 1.5, 7)
CHUNK = 8  # also what the last few members are solved in
SETTINGS = dict(
    stepsize_controller=diffrax.PIDController(
        rtol=1e-10, atol=1e-10, dtmin=1e-13, force_dtmin=False
    ),
    max_steps=1500,
)


class Push(eqx.Module):
    """A smooth effort; `broken` joins it after 1 s."""

    tau: jax.Array
    broken: jax.Array

    def __call__(self, t, q, qd, linkage):
        return self.tau * jnp.sin(3 * t) + jnp.where(t > 1, self.broken, 0.0)


def members():
    """A batch of all topologies: linkages, starts and forces."""
    rng = np.random.default_rng(5)
    linkages = [
        random_linkage(topology, rng) for _ in range(6) for topology in fj.TOPOLOGIES
    ]
    size = len(linkages)
    state0 = fj.State(rng.uniform(-1, 1, (size, 3)), rng.uniform(-1, 1, (size, 3)))
    push = Push(jnp.asarray(rng.uniform(-1, 1, (size, 3))), jnp.zeros(size))
    return jax.tree.map(lambda *a: jnp.stack(a), *linkages), state0, (push,)


def run(batch, **keywords):
    linkage, state0, forces = batch
    arguments = dict(SETTINGS, chunk=CHUNK, forces_axes=0)
    return fj.sweep(linkage, state0, TS, forces, **{**arguments, **keywords})


def alone(batch, member):
    linkage, state0, forces = jax.tree.map(lambda a: a[member], batch)
    return fj.simulate(linkage, state0, TS, forces, throw=False, **SETTINGS)


def reason(solution, member):
    return jax.tree.map(lambda a: a[member], solution.result)


def successful(solution):
    return np.asarray(solution.result == diffrax.RESULTS.successful)


def assert_equal(solution, other, tolerance=1e-9):
    for a, b in ((solution.q, other.q), (solution.qd, other.qd)):
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)


@pytest.fixture(scope="module")
def batch():
    return members()


@pytest.fixture(scope="module")
def clean(batch):
    return run(batch)


def test_members_equal_those_of_vmap(batch, clean):
    plain = jax.vmap(
        lambda *member: fj.simulate(*member[:2], TS, member[2], throw=False, **SETTINGS)
    )(*batch)
    assert jax.tree.structure(clean) == jax.tree.structure(plain)
    for a, b in zip(jax.tree.leaves(clean), jax.tree.leaves(plain)):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
    assert successful(clean).all() and successful(plain).all()
    np.testing.assert_array_equal(clean.ts, plain.ts)
    np.testing.assert_allclose(clean.q, plain.q, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(clean.qd, plain.qd, rtol=1e-7, atol=1e-7)
    # Another width of the batch rounds differently, which may tip a step or two.
    np.testing.assert_allclose(
        clean.stats["num_steps"], plain.stats["num_steps"], rtol=0, atol=5
    )


def test_members_equal_single_simulations(batch, clean):
    for member in (0, 8, 23, 41):
        single = alone(batch, member)
        np.testing.assert_allclose(clean.q[member], single.q, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(clean.qd[member], single.qd, rtol=1e-7, atol=1e-7)


# Members that differ from the others

NAN_START, NAN_LATER, SPENT, FAST = 3, 12, 21, 0
FAILED = [NAN_START, NAN_LATER, SPENT]


@pytest.fixture(scope="module")
def mixed(batch):
    """A batch with members that fail, each in its own way, and a fast one."""
    linkage, (q, qd), (push,) = batch
    q, qd = q.copy(), qd.copy()
    q[NAN_START, 1] = np.nan
    qd[SPENT], qd[FAST] = [1000, 0, 0], [70, 0, 0]
    push = eqx.tree_at(lambda p: p.broken, push, push.broken.at[NAN_LATER].set(jnp.nan))
    return linkage, fj.State(q, qd), (push,)


@pytest.fixture(scope="module")
def swept(mixed):
    return run(mixed)


def test_failed_members_have_their_own_results(mixed, swept):
    assert np.flatnonzero(~successful(swept)).tolist() == FAILED
    assert reason(swept, NAN_START) == diffrax.RESULTS.nonfinite
    assert reason(swept, NAN_LATER) == diffrax.RESULTS.nonfinite
    assert reason(swept, SPENT) == diffrax.RESULTS.max_steps_reached
    assert swept.stats["num_steps"][SPENT] == SETTINGS["max_steps"]
    for member in (NAN_LATER, SPENT):  # alone, a start of NaN is refused
        assert reason(swept, member) == alone(mixed, member).result


def test_failed_members_are_nan_from_there_on(swept, clean):
    assert np.isnan(swept.q[NAN_START]).any(axis=-1).all()
    # No step comes up to 1 s itself.
    early, late = TS < 1, TS > 1
    assert np.isnan(swept.q[NAN_LATER][late]).all()
    assert np.isnan(swept.qd[NAN_LATER][late]).all()
    np.testing.assert_allclose(
        swept.q[NAN_LATER][early], clean.q[NAN_LATER][early], rtol=1e-8, atol=1e-8
    )
    assert np.isnan(swept.q[SPENT][-1]).all()
    assert np.isfinite(swept.q[SPENT][0]).all()


def test_the_others_do_not_notice(swept, clean):
    others = np.delete(np.arange(len(clean.q)), [*FAILED, FAST])
    assert_equal(*[jax.tree.map(lambda a: a[others], s) for s in (swept, clean)], 1e-9)
    for name in ("num_steps", "num_accepted_steps"):
        np.testing.assert_array_equal(
            swept.stats[name][others], clean.stats[name][others]
        )


def test_a_fast_member_is_right(mixed, swept):
    steps = np.delete(swept.stats["num_steps"], [*FAILED, FAST])
    assert swept.stats["num_steps"][FAST] > 2 * steps.max()
    single = alone(mixed, FAST)
    assert swept.stats["num_steps"][FAST] == pytest.approx(
        single.stats["num_steps"], abs=4
    )
    np.testing.assert_allclose(swept.q[FAST], single.q, rtol=1e-6, atol=1e-6)


def test_throw_tells_how_many_failed(mixed):
    with pytest.raises(RuntimeError, match=r"3 of 42 members failed.* member 3\."):
        run(mixed, throw=True)


# Derivatives


def test_failed_members_add_nothing_to_a_gradient():
    linkage = random_linkage("RRP", np.random.default_rng(1))
    rng = np.random.default_rng(2)
    q, qd = rng.uniform(-1, 1, (2, 4, 3))
    q[1, 0] = np.nan

    def with_mass(mass):
        return eqx.tree_at(lambda k: k.mass, linkage, mass)

    def distance(mass):
        solution = fj.sweep(
            with_mass(mass), fj.State(q, qd), TS[:3], chunk=4, **SETTINGS
        )
        counted = solution.result == diffrax.RESULTS.successful
        end = jnp.where(counted[:, None], solution.q[:, -1], 0)
        return jnp.sum(end**2), solution

    @jax.jit
    @jax.grad
    def single(mass, q, qd):
        end = fj.simulate(with_mass(mass), fj.State(q, qd), TS[:3], **SETTINGS).q[-1]
        return jnp.sum(end**2)

    gradient, solution = jax.jit(jax.grad(distance, has_aux=True))(linkage.mass)
    assert successful(solution).tolist() == [True, False, True, True]
    assert np.isnan(solution.q[1]).any(axis=-1).all()
    expected = sum(single(linkage.mass, q[i], qd[i]) for i in (0, 2, 3))
    assert np.abs(expected).max() > 1e-3
    np.testing.assert_allclose(gradient, expected, rtol=1e-7, atol=1e-9)


# What is shared


def ramp(t, linkage):
    return jnp.ones(3) * t, jnp.ones(3)


@pytest.mark.parametrize("shared", ["damper", "controller"])
def test_arrays_without_the_axis_are_shared(shared):
    linkage = random_linkage("RPR", np.random.default_rng(3))
    rng = np.random.default_rng(4)
    starts = rng.uniform(-1, 1, (3, 3))

    def forces(coefficient, kp):
        return (
            fj.JointDamper(coefficient),
            fj.PDController(kp, 4.0, 50.0, ramp),
        )

    each = [forces(*rng.uniform(0.5, [3, 40])) for _ in starts]
    # A function among the arrays, such as this reference, has no axis.
    stacked = jax.tree.map(
        lambda *a: np.stack(a) if eqx.is_array(a[0]) else a[0], *each
    )
    first = each[0]
    if shared == "damper":
        together, axes = (first[0], stacked[1]), (None, 0)
        each = [(first[0], element[1]) for element in each]
    else:
        together, axes = (stacked[0], first[1]), (0, None)
        each = [(element[0], first[1]) for element in each]
    solution = fj.sweep(
        linkage,
        fj.State(starts, np.zeros(3)),
        TS,
        together,
        forces_axes=axes,
        **SETTINGS,
    )
    assert solution.q.shape == (3, len(TS), 3)
    for member, q in enumerate(starts):
        single = fj.simulate(
            linkage, fj.State(q, np.zeros(3)), TS, each[member], **SETTINGS
        )
        np.testing.assert_allclose(solution.q[member], single.q, rtol=1e-8, atol=1e-8)


# Checkpoints


@pytest.fixture
def solved(monkeypatch):
    """The chunks solved from here on; a trace alone is none."""
    chunks = []
    original = module._solve_chunk

    def recorded(*arguments):
        if not fj.validation.is_traced(arguments):
            chunks.append(arguments)
        return original(*arguments)

    monkeypatch.setattr(module, "_solve_chunk", recorded)
    return chunks


def test_a_checkpoint_spares_finished_chunks(mixed, swept, solved, tmp_path):
    folder = tmp_path / "new" / "folder"
    first = run(mixed, checkpoint=folder)
    saved = sorted(folder.iterdir())
    assert len(saved) == len(solved) > len(first.q) // CHUNK
    assert {file.suffix for file in saved} == {".npz"}
    solved.clear()

    again = run(mixed, checkpoint=str(folder))
    assert not solved
    assert jax.tree.structure(again) == jax.tree.structure(first)
    for a, b, c in zip(*map(jax.tree.leaves, (again, first, swept))):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)

    saved[2].unlink()
    again = run(mixed, checkpoint=folder)
    assert len(solved) == 1
    assert sorted(folder.iterdir()) == saved
    np.testing.assert_array_equal(again.q, first.q)


def test_a_checkpoint_serves_no_other_sweep(batch, clean, solved, tmp_path):
    linkage, (q, qd), (push,) = batch
    run(batch, checkpoint=tmp_path)
    chunks = len(solved)
    solved.clear()
    moved = linkage, fj.State(q, qd + 1e-9), (push,)
    other = run(moved, checkpoint=tmp_path)
    assert len(solved) == chunks
    assert not np.array_equal(other.q, clean.q)


def test_a_checkpoint_may_be_of_another_chunk(batch, clean, solved, tmp_path):
    """The chunks of 8 do not take up those of one member that were there before."""
    tiny = jax.tree.map(lambda a: a[:CHUNK], batch)
    ones = run(tiny, checkpoint=tmp_path, chunk=1)
    solved.clear()
    eights = run(tiny, checkpoint=tmp_path)
    assert solved
    assert_equal(ones, eights, 1e-7)
    np.testing.assert_allclose(eights.q, clean.q[:CHUNK], rtol=1e-8, atol=1e-8)


# Progress, devices, compilations


class Recorder(diffrax.NoProgressMeter):
    seen: list

    def step(self, state, progress):
        self.seen.append(float(progress))
        return state


def test_progress_rises_to_one(mixed):
    recorder = Recorder([])
    run(mixed, progress_meter=recorder)
    assert len(recorder.seen) >= len(mixed[1].q) // CHUNK
    assert 0 <= recorder.seen[0] < 1 and recorder.seen[-1] == 1
    assert (np.diff(recorder.seen) >= 0).all()


WORKER = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
address, processes, index, devices, path = sys.argv[1:]
if int(processes) > 1:
    jax.distributed.initialize(address, int(processes), int(index))
import numpy as np
import test_sweep
assert jax.device_count() == int(devices)
solution = test_sweep.run(test_sweep.members(), chunk=4)
steps = solution.stats["num_steps"]
good = test_sweep.successful(solution)
np.savez(path, q=solution.q, qd=solution.qd, steps=steps, good=good)
"""


def workers(folder, processes, devices):
    """What each of some processes returns, all devices seen by all of them."""
    with socket.socket() as port:
        port.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{port.getsockname()[1]}"
    here = Path(__file__).parent
    flag = f"--xla_force_host_platform_device_count={devices // processes}"
    env = dict(
        os.environ,
        JAX_PLATFORMS="cpu",
        XLA_FLAGS=flag,
        PYTHONPATH=os.pathsep.join([str(here), str(here.parent)]),
    )
    started, answers = [], []
    try:
        for index in range(processes):
            path = folder / f"{index}.npz"
            arguments = [address, processes, index, devices, path]
            command = [sys.executable, "-c", WORKER, *map(str, arguments)]
            started.append(
                (path, subprocess.Popen(command, env=env, stderr=subprocess.PIPE))
            )
        for path, process in started:
            _, errors = process.communicate(timeout=300)
            assert process.returncode == 0, errors.decode()[-3000:]
            answers.append(np.load(path))
    finally:
        for _, process in started:
            process.kill()
    return answers


@pytest.mark.parametrize("processes, devices", [(1, 4), (2, 2)])
def test_more_devices_and_processes_change_nothing(processes, devices, clean, tmp_path):
    for answer in workers(tmp_path, processes, devices):
        assert answer["good"].all()
        np.testing.assert_allclose(answer["q"], clean.q, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(answer["qd"], clean.qd, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(
            answer["steps"], clean.stats["num_steps"], rtol=0, atol=5
        )


def test_other_values_need_no_new_trace(batch, clean, monkeypatch):
    calls = []
    original = fj.integration._vector_field

    def counted(*arguments):
        calls.append(1)
        return original(*arguments)

    monkeypatch.setattr(fj.integration, "_vector_field", counted)
    linkage, (q, qd), forces = batch
    other = run((linkage, fj.State(q + 0.1, qd), forces))
    assert not calls
    assert not np.array_equal(other.q, clean.q)
    # Fewer members need none either, and a new number of times shows the counting.
    run(jax.tree.map(lambda a: a[:11], batch))
    assert not calls
    linkage, state0, forces = jax.tree.map(lambda a: a[0], batch)
    ts = np.linspace(0, 1, 37)
    jax.eval_shape(lambda q: fj.simulate(linkage, fj.State(q, q), ts), state0.q)
    assert calls


def test_an_implicit_solver_finds_its_tolerances():
    linkage = fj.scenes.fig5().linkage
    start = fj.State(np.zeros((2, 3)) + [[0.0], [0.1]], np.zeros(3))
    steps = diffrax.PIDController(rtol=1e-8, atol=1e-8)
    solution = fj.sweep(
        linkage, start, [0, 0.2], solver=diffrax.Kvaerno5(), stepsize_controller=steps
    )
    alone = fj.simulate(linkage, fj.State(start.q[1], start.qd), [0, 0.2])
    np.testing.assert_allclose(solution.q[1], alone.q, atol=1e-6)
