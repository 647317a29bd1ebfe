import gc
import time
from pathlib import Path

import jax
import numpy as np
import pytest
import sweep_batch

import fdof_jax as fj
from fdof_jax.tuning.result import History

# JAX is set up as in an application, so the laws hold for what users run.
fj.configure(x64=True)
jax.config.update("jax_numpy_rank_promotion", "raise")

# Tests are long series of traces, whose objects mostly stay; Python would look through
# them for cycles again and again.
gc.set_threshold(50_000)
HARD = Path(__file__).parent / "hard"
# Files that take longest, which begin first so that all workers end together.
LONGEST = {
    "test_guides",
    "test_notebooks",
    "test_holding",
    "test_holding_of_several",
    "test_derivatives_at_rest",
    "test_signals",
    "test_gradients",
    "test_forces_guide",
    "test_chain_elements",
    "test_chain_motions",
    "test_switches",
    "test_tuning",
    "test_refusals",
}
# Doctests that compile much.
LONG_EXAMPLES = {
    "fdof_jax.servo.linearization.closed_loop_modes",
    "fdof_jax.servo.linearization.equilibrium",
    "fdof_jax.servo.linearization.linearize",
    "fdof_jax.servo.loops.closed_loop",
    "fdof_jax.servo.loops.margins",
    "fdof_jax.servo.loops.open_loop",
    "fdof_jax.servo.measures.response",
    "fdof_jax.forces.holders.Brake",
    "fdof_jax.forces.holders.HardStops",
    "fdof_jax.forces.holders.JointFriction",
    "fdof_jax.forces.payload.Payload",
    "fdof_jax.forces.reset.Reset",
    "fdof_jax.identification.fitting.fit_each",
    "fdof_jax.simulation.until.End",
    "fdof_jax.simulation.until.Until",
    "fdof_jax.simulation.sampled_control.simulate_sampled",
    "fdof_jax.tuning.losses.Tracking",
    "fdof_jax.tuning.losses.joint_errors",
    "fdof_jax.tuning.within_limits.tune_within",
}
# A program of so many bytes takes half a second to compile; the quick tests may have so
# many of them, which take most of their time.
LARGE, MOST_LARGE = 60_000, 100
BEGIN = time.time()


# Sweeps that several files test.


@pytest.fixture(scope="session")
def batch():
    return sweep_batch.members()


@pytest.fixture(scope="session")
def clean(batch):
    return sweep_batch.run(batch)


@pytest.fixture(scope="session")
def mixed(batch):
    return sweep_batch.with_failures(batch)


@pytest.fixture(scope="session")
def swept(mixed):
    return sweep_batch.run(mixed)


@pytest.fixture
def tuned():
    """Returns a tuning result made without a search; one of its gains is at a bound."""
    scene = fj.scenes.fig7()
    start = np.array([[1500.0, 20000.0, 800.0], [80.0, 50.0, 50.0]])
    gains = start + [[4500, 0, 0], [0, 0, 10]]
    controller = fj.PDController(*gains, [1000, 300, 400], fj.CircleTask())
    history = History(
        loss=np.array([0.04, 0.01]),
        gradient_norm=np.ones(2),
        gains=np.stack([start, gains]),
        saturated=np.full((2, 3), 0.25),
        effort=np.full((2, 3), 0.5),
        tip_error=np.array([0.2, 0.1]),
        wall_time=np.arange(2.0),
    )
    return fj.TuneResult(
        scene=scene._replace(forces=(controller,)),
        loss=0.01,
        histories=[history],
        lower=start / 4,
        upper=start * 4,
        converged=False,
        message="stopped where a < b",
        member_tip_error=np.array([0.06]),
        member_loss=np.array([0.01]),
        settings={},
    )


@pytest.fixture(autouse=True, scope="module")
def few_programs():
    """Compiled programs take memory: about a GB for each 1,500 maps of the process."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > 6_000:
        jax.clear_caches()


def pytest_configure(config):
    """Keeps compiled programs beside pytest's cache; most test time is compilation."""
    if hasattr(config, "cache"):  # not with -p no:cacheprovider
        fj.configure(cache=config.cache.mkdir("programs"))


def programs(config):
    """Returns the files of compiled programs that are kept."""
    if not hasattr(config, "cache"):
        return []
    return [*config.cache.mkdir("programs").glob("*/*-cache")]


def pytest_sessionfinish(session):
    """Fails a run of the quick tests that has compiled too many large programs."""
    config = session.config
    if hasattr(config, "workerinput") or config.option.markexpr != "not slow":
        return
    stats = [path.stat() for path in programs(config)]
    large = sum(s.st_size > LARGE and s.st_mtime > BEGIN for s in stats)
    if large > MOST_LARGE:
        words = f"{large} programs of more than {LARGE} bytes, at most {MOST_LARGE}"
        config.get_terminal_writer().line(f"\nThe quick tests compiled {words}.")
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_report_header(config):
    kept = any(programs(config))
    return f"jax {jax.__version__}, {jax.default_backend()}, float64. " + (
        "Compiled programs of an earlier run are taken from .pytest_cache."
        if kept
        else "This first run compiles for some minutes; later ones take half of it."
    )


def pytest_collection_modifyitems(items):
    """Sorts the tests, and marks the hard scenes slow, as most compile much."""
    items.sort(key=lambda item: item.path.stem not in LONGEST)
    for item in items:
        hard = item.path.parent == HARD
        if hard or item.name in LONG_EXAMPLES:
            item.add_marker(pytest.mark.slow)
