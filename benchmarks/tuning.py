"""Gain tuning on Fig 7's circle: the progress of each optimiser.

The best rms tip error so far is recorded against simulated time (a gradient's six
tangents count as six more motions) and against wall time, compilation apart. All
optimisers have the same bounds and start from the same random gains; the median of the
starts counts.

Robust gains are also judged on members that they were not tuned on.
"""

import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

import fdof_jax as fj
from fdof_jax import scenes
from fdof_jax.search.bounded import METHODS, minimise
from fdof_jax.search.lanes import Lanes
from fdof_jax.steps.tolerances import adaptive
from fdof_jax.tuning.losses import evaluate_gains, tip_errors, with_gains

from .measure import record, skipped

PROTOCOL = "tuning"
WALL = 2.0, 8.0  # where the tables read off [s]
SIMULATED = 1e3, 1e4  # [s]
POPULATION = 16


class _Enough(Exception):
    pass


class _Trace:
    """The best loss so far over simulated and wall time."""

    def __init__(self, budget: float):
        self.rows: list[tuple[float, float, float]] = []
        self.best, self.simulated = np.inf, 0.0
        self.budget, self.began = budget, time.perf_counter()

    def add(self, losses: Any, motions: int, t1: float) -> None:
        self.simulated += motions * t1
        wall = time.perf_counter() - self.began
        self.best = min(self.best, float(np.nanmin(losses)))
        self.rows.append((self.simulated, wall, 1e3 * self.best**0.5))
        if wall > self.budget and self.simulated > SIMULATED[-1]:
            raise _Enough

    def at(self, column: int, limit: float) -> float:
        """Returns the best rms tip error [mm] within the limit."""
        values = [row[2] for row in self.rows if row[column] <= limit]
        return values[-1] if values else np.inf


def _loss(scene):
    """Returns the mean squared tip error by the library's default solver."""
    ts = jnp.linspace(0, scene.t1, 1001)
    solution = fj.simulate(
        scene.linkage,
        scene.state0,
        ts,
        scene.forces,
        stepsize_controller=adaptive(1e-6, 1e-5),
        throw=False,
    )
    return jnp.sum(tip_errors(scene, solution) ** 2)


def _value(scene) -> Callable:
    """Returns losses of log-gains (lane, 6)."""

    @jax.jit
    @jax.vmap
    def loss(z):
        return _loss(with_gains(scene, jnp.exp(z).reshape(2, 3)))

    return lambda z: np.asarray(loss(jnp.atleast_2d(z)))


def _by_gradients(method: str, scene, start, low, high, trace: _Trace) -> None:
    lanes = Lanes(evaluate_gains, [[(scene, tip_errors, np.ones((2, 3)))]])

    def evaluate(z, runs):
        found = lanes(z, runs)
        trace.add(found.loss, 7, scene.t1)
        return found

    minimise(
        evaluate, start[None], low[None], high[None], method=method, max_steps=10_000,
        enough=0.0,
    )  # fmt: skip


def _nelder_mead(value, start, low, high, trace, t1) -> None:
    def one(z):
        loss = value(z)
        trace.add(loss, 1, t1)
        return loss[0]

    scipy.optimize.minimize(
        one, start, method="Nelder-Mead", bounds=list(zip(low, high)),
        options=dict(maxfev=10**6, xatol=0, fatol=0),
    )  # fmt: skip


def _random(value, start, low, high, trace, t1, seed) -> None:
    draw = np.random.default_rng(seed)
    while True:
        trace.add(value(draw.uniform(low, high, (POPULATION, 6))), POPULATION, t1)


def _cma(value, start, low, high, trace, t1, seed) -> None:
    import cma

    options = dict(
        bounds=[low.tolist(), high.tolist()], popsize=POPULATION, seed=seed + 1,
        verbose=-9, tolfun=0, tolx=0,
    )  # fmt: skip
    search = cma.CMAEvolutionStrategy(
        start, float(np.ptp([low[0], high[0]])) / 4, options
    )
    while True:
        asked = search.ask()
        losses = value(np.array(asked))
        trace.add(losses, POPULATION, t1)
        search.tell(asked, losses.tolist())


def _race(quick: bool) -> Iterator[dict]:
    scene = scenes.fig7()
    t1 = scene.t1
    controller = scene.forces[0]
    middle = np.log(np.stack([controller.kp, controller.kd])).ravel()
    value = _value(scene)
    free = {
        "Nelder-Mead (SciPy)": _nelder_mead,
        "random search": _random,
        "CMA-ES": _cma,
    }
    try:
        import cma  # noqa: F401
    except ImportError as error:
        yield skipped(PROTOCOL, "CMA-ES", str(error))
        del free["CMA-ES"]
    for factor in (4.0, 10.0):
        low, high = middle - np.log(factor), middle + np.log(factor)
        starts = np.random.default_rng(3).uniform(low, high, (1 if quick else 3, 6))
        value(starts[0])
        value(np.repeat(starts[:1], POPULATION, axis=0))
        for name in (*METHODS, *free):
            traces = []
            for seed, start in enumerate(starts):
                if name in METHODS:  # compiled by an evaluation of its own
                    warm = Lanes(
                        evaluate_gains, [[(scene, tip_errors, np.ones((2, 3)))]]
                    )
                    warm(start[None], np.array([0]))
                trace = _Trace(0.0 if quick else WALL[-1])
                try:
                    if name in METHODS:
                        _by_gradients(name, scene, start, low, high, trace)
                    elif name.startswith("Nelder"):
                        _nelder_mead(value, start, low, high, trace, t1)
                    else:
                        free[name](value, start, low, high, trace, t1, seed)
                except _Enough:
                    pass
                traces.append(trace)
            read = {
                f"{what} {limit:g}": float(np.median([t.at(i, limit) for t in traces]))
                for i, what, limits in ((0, "simulated", SIMULATED), (1, "wall", WALL))
                for limit in limits
            }
            yield record(
                protocol=PROTOCOL, problem=f"within x{factor:g}", solver=name,
                kind="race", best=read,
            )  # fmt: skip


def _timed(what: str, times: int, tuned: Callable, starts: int) -> Iterator[dict]:
    began = time.perf_counter()
    result = tuned()
    first = time.perf_counter() - began
    walls = []
    for _ in range(times):
        began = time.perf_counter()
        result = tuned()
        walls.append(time.perf_counter() - began)
    results = result if isinstance(result, list) else [result]
    rms = np.array([np.sqrt(r.losses) for r in results])
    near = rms <= 1.01 * rms.min(axis=1, keepdims=True)
    yield record(
        protocol=PROTOCOL, problem=what, solver="levenberg-marquardt", kind="time",
        batch=starts, times=walls, time_median=float(np.median(walls)),
        compile_time=first - float(np.median(walls)), near=float(near.mean()),
    )  # fmt: skip


def _robust(quick: bool) -> Iterator[dict]:
    """Returns worst rms tip errors: payloads to 2 kg, starts 0.3 m off, double speeds.

    The gains are tuned on the nominal scene, on another ensemble, or on the members
    that judge: no gains within the bounds do better than the last.
    """
    scene = scenes.fig7()
    pd = scene.forces[0]
    computed = fj.control.ComputedTorque(100.0, 20.0, pd.limit, pd.reference)
    varied = dict(payload=(0, 2), start_offset=0.3, speed=(1, 2))
    for name, controller in (("PD", pd), ("computed torque", computed)):
        nominal = scene._replace(forces=(controller,))
        seen = fj.tuning.perturbed(nominal, 2 if quick else 16, seed=1, **varied)
        held = fj.tuning.perturbed(nominal, 2 if quick else 64, seed=2, **varied)
        judge = jax.jit(jax.vmap(lambda s, g: _loss(with_gains(s, g)), (0, None)))
        for factor in (4.0, 10.0):
            worst = {}
            for how, ensemble in (("nominal", None), ("robust", seen), ("bound", held)):
                over = "mean" if ensemble is None else "worst"
                tuned = fj.tune(nominal, factor=factor, ensemble=ensemble, over=over)
                losses = np.asarray(judge(held, jnp.asarray(tuned.gains)))
                worst[how] = 1e3 * float(losses.max()) ** 0.5
            yield record(
                protocol=PROTOCOL, problem=f"within x{factor:g}", solver=name,
                kind="robust", worst=worst,
            )  # fmt: skip


def run(quick: bool) -> Iterator[dict]:
    scene, arms = scenes.fig7(), list(fj.tuning.circle_scenes().values())
    few, times = (2, 1) if quick else (20, 3)
    for factor in (4.0, 10.0):
        one = lambda factor=factor: fj.tune(scene, factor=factor)
        yield from _timed(f"x{factor:g}, from the paper's gains", times, one, 1)
    for factor in (4.0, 10.0):
        many = lambda factor=factor: fj.tune(scene, factor=factor, starts=few)
        yield from _timed(f"x{factor:g}, {few} starts", 1, many, few)
    yield from _timed("RPR on the league's circle", times, lambda: fj.tune(arms[2]), 1)
    each = 2 if quick else 32
    every = lambda: fj.tuning.tune_each(arms, starts=each)
    yield from _timed(f"7 topologies x {each} starts", 1, every, 7 * each)
    yield from _robust(quick)
    yield from _race(quick)
