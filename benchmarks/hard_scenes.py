"""The motions of `tests/hard`, in a form that other engines can run.

Numbers are those of the table of hard cases in the page. Every motion is judged by one
number, which has to stay below a bound: its error, unless `judge` says otherwise.
"""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj

from .chain import Drive

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
import helpers
from hard import scenes as hard

STIFF_TOLERANCE = 1e-9  # see tests/hard/test_driven.py
Judge = Callable[[np.ndarray, np.ndarray], float]  # of q, qd: (time, 3)


class HardScene(NamedTuple):
    """A motion of one arm under a `Drive`, and the bounds that it must meet.

    - `judge`: the number that must not exceed `bound`.
    - `tolerance`: the tolerance of adaptive solvers.
    - `stiff`: whether an implicit solver is recommended.
    - `first_step`: the first step of adaptive solvers [s]; None: they estimate it.
    - `most_steps`: the most steps that an adaptive solver may take.
    - `may_refuse`: whether the report "ill-conditioned" is as good as a solution.
    - `derivative`: whether the derivative of q at the end in q at the start, (3, 3), is
      judged instead of the motion.
    """

    number: int
    name: str
    linkage: fj.Linkage
    state0: fj.State
    ts: np.ndarray
    judge: Judge
    bound: float
    drive: Drive = Drive()
    tolerance: float = 1e-12
    stiff: bool = False
    first_step: float | None = 1e-3
    most_steps: float = np.inf
    may_refuse: bool = False
    derivative: bool = False

    @property
    def driven(self) -> Drive | None:
        """Returns the drive, or None where there is none."""
        return self.drive if np.any(self.drive) else None


def _error(exact: Any, rows: Any = ...) -> Judge:
    return lambda q, qd: float(np.abs(q[rows] - np.asarray(exact)).max())


def _slope(scene: HardScene, exact: Any, bound: float) -> HardScene:
    """Returns the scene judged by its derivative, over the largest entry."""
    return scene._replace(
        name=f"{scene.name}: derivative",
        judge=lambda slope, _: hard.largest_error(slope, exact),
        bound=bound,
        derivative=True,
        most_steps=np.inf,
    )


def _of(number: int, name: str, scene: hard.Scene, bound: float, **more) -> HardScene:
    """Returns a scene from the form that the tests use."""
    effort, damper = scene.forces
    drive = Drive(np.asarray(effort.tau), damping=np.asarray(damper.coefficient))
    judge = more.pop("judge", None) or _error(scene.q, scene.rows)
    return HardScene(
        number, name, scene.linkage, scene.state0, np.asarray(scene.ts), judge, bound,
        drive=drive, **more,
    )  # fmt: skip


def _energy_change(linkage: fj.Linkage) -> Judge:
    return lambda q, qd: float(hard.drift(linkage, q, qd))


def _stiff(kp: float) -> HardScene:
    exact, three = hard.DRIVEN[f"stiff-{kp:.0e}"], np.ones(3)
    drive = Drive(
        stiffness=kp * three,
        target=np.asarray(hard.TARGET.target),
        damping=2 * np.sqrt(kp) * three,
    )
    return HardScene(
        17, f"PD, kp = {kp:.0e}", hard.arm(), hard.START, np.array([0, *exact["ts"]]),
        _error(exact["q"], slice(1, None)), 1e-6, drive=drive,
        tolerance=STIFF_TOLERANCE, stiff=True, first_step=1e-6,
    )  # fmt: skip


def _creep(q, qd):
    """Returns the velocities' error against the balance of damping and gravity."""
    exact = [
        -np.asarray(fj.inverse_dynamics(hard.arm(), row, np.zeros(3), np.zeros(3)))
        for row in q[1:]
    ]
    exact = np.array(exact) / 1e6
    return float(np.max(np.abs(qd[1:] - exact).max(1) / np.abs(exact).max(1)))


def _scaled(name: str, size: float, mass: float, usual: np.ndarray) -> HardScene:
    linkage = hard.arm(
        length=np.array(hard.USUAL["length"]) * size,
        com=np.array(hard.USUAL["com"]) * size,
        mass=[mass] * 3,
        inertia=[mass * size**2 / 12] * 3,
    )
    ts = np.linspace(0, 5, 11) * np.sqrt(size)
    return HardScene(
        21, name, linkage, hard.START, ts, _error(usual), 1e-7, tolerance=1e-11,
        first_step=1e-3 * np.sqrt(size),
    )  # fmt: skip


def _turned(turns: float) -> HardScene:
    offset = hard.START.q + 2 * np.pi * turns
    left = hard.without_turns(offset)
    ts = np.linspace(0, 5, 11)
    plain = np.asarray(_tight(fj.State(left, hard.START.qd), ts))
    ulp = np.spacing(offset.max())

    def judge(q, qd):
        return float(np.abs((q - offset) - (plain - left)).max())

    return HardScene(
        22, f"{turns:.0e} turns away", hard.arm(), fj.State(offset, hard.START.qd), ts,
        judge, max(1e-9, ulp), tolerance=1e-11,
    )  # fmt: skip


def _tight(state0: fj.State, ts: np.ndarray) -> np.ndarray:
    steps = hard.controller(1e-13)
    return fj.simulate(hard.arm(), state0, ts, stepsize_controller=steps).q


def _massless() -> HardScene:
    """Returns a scene whose last acceleration is undetermined: no answer is right."""
    massless = eqx.tree_at(
        lambda arm: (arm.com, arm.inertia),
        hard.arm(),
        (jnp.array([[0.5, 0], [0.5, 0], [0, 0]]), jnp.array([1 / 12, 1 / 12, 0])),
    )
    return HardScene(
        5, "no inertia at the tip", massless, hard.START, np.linspace(0, 2, 21),
        lambda q, qd: np.inf, 0.0, tolerance=1e-11, may_refuse=True,
    )  # fmt: skip


def _common(name: str) -> hard.Scene:
    """Returns a scene of tests/reference.json, which holds fewer times."""
    scene, r = helpers.SCENES[name], helpers.load(name)
    times = [state["t"] for state in scene["states"]]
    ts = np.linspace(0, times[-1], hard.OUTPUTS)
    rows = [int(np.flatnonzero(ts == t)[0]) for t in times]
    q = np.array([helpers.to_joint(scene, state["q"]) for state in scene["states"]])
    return hard.Scene(r.linkage, r.state0, r.forces, ts, rows, q)


_UPRIGHT, _MOVED = np.array([np.pi / 2, 0, 0]), np.array([1e-6, 0, 0])


def _beside_upright() -> hard.Scene:
    """Returns a scene that starts a microradian beside the upright equilibrium."""
    return hard.free(hard.arm(), _UPRIGHT + _MOVED, np.linspace(0, 1, hard.OUTPUTS))


def _growth_error(q: np.ndarray) -> float:
    """Returns the relative error of that scene's growth rate while it is small."""
    scene = _beside_upright()
    exact = [hard.linear_motion(t, upright=True) @ _MOVED for t in scene.ts]
    away = np.asarray(q) - _UPRIGHT
    size, exact_size = (np.linalg.norm(a, axis=1) for a in (away, exact))
    small = size < 1e-3
    if not 5 < small.sum() < hard.OUTPUTS:
        return np.inf
    rate, exact_rate = (np.diff(np.log(a[small])) for a in (size, exact_size))
    return np.abs(rate / exact_rate - 1).max()


def motions() -> Iterator[HardScene]:
    """Returns all scenes that are a motion of one arm under a `Drive`."""
    load, common, fig5 = hard.load, _common, hard.fig5
    yield _of(1, "Fig 5, no inertia", load("fig5"), 1e-6, tolerance=1e-10)
    yield _of(2, "heavy tip, 1e3 kg", load("heavy-tip-1e3"), 1e-8)
    yield _of(2, "heavy tip, 1e6 kg", load("heavy-tip-1e6"), 1e-5)
    heavy = load("heavy-tip-1e9")
    yield _of(
        3, "heavy tip, 1e9 kg", heavy, 1e-3, tolerance=1e-11, most_steps=1e4,
        may_refuse=True,
    )  # fmt: skip
    yield _of(4, "light tip, 1e-6 kg", load("light-tip-1e-6"), 1e-6)
    yield _of(4, "light tip, 1e-9 kg", load("light-tip-1e-9"), 1e-8)
    yield _massless()
    yield _of(6, "massless tip", common("hard-masslesstip-RRR"), 1e-9)
    yield _of(6, "point mass on a slide", common("hard-pointtip-RRP"), 1e-9)
    yield _of(6, "slide through a pivot", load("turn-slide-RPR"), 1e-9)
    yield _of(7, "two pivots in one", common("hard-zerolengthRR"), 1e-9)
    yield _of(7, "parallel slides, PPR", load("parallel-axes-PPR"), 1e-9)
    yield _of(7, "parallel slides, RPP", load("parallel-axes-RPP"), 1e-9)
    near = dict(most_steps=1e4)
    yield _of(8, "nearly parallel, PPR", load("near-parallel-PPR"), 1e-8, **near)
    yield _of(8, "nearly parallel, RPP", load("near-parallel-RPP"), 1e-6, **near)
    through = _of(9, "slide through 0", load("driven-through-0-RPR"), 1e-9)
    yield through
    yield _slope(through, hard.REFERENCE["driven-through-0-RPR"]["dq_dq0"], 1e-6)
    fast = dict(most_steps=1e5)
    yield _of(10, "1000 rad/s, all links", load("spin"), 1e-6, **fast)
    tip = load("spin-of-the-tip")
    yield _of(10, "1000 rad/s, the tip", tip, 1e-6, tolerance=1e-14, **fast)
    growth = lambda q, qd: _growth_error(q)
    yield _of(11, "growth beside upright", _beside_upright(), 0.01, judge=growth)
    hanging = np.array([-np.pi / 2, 0, 0])
    rest = hard.free(hard.arm(), hanging, np.array([0.0, 10.0]), q=hanging)
    resting = _of(12, "hanging at rest", rest, 1e-12, tolerance=1e-11)
    yield resting
    yield _slope(resting, hard.linear_motion(10.0), 1e-6)
    start = fig5(np.array([0, 1.5, 2]))
    yield _of(13, "Fig 5, first step unknown", start, 1e-8, first_step=None)
    late = fig5(np.array([0, 5.5, 10, 15]))
    yield _of(14, "Fig 5, 15 s", late, 1e-6, tolerance=1e-13)
    long = fig5(np.linspace(0, 60, hard.OUTPUTS))
    change = _energy_change(long.linkage)
    yield _of(14, "energy, 60 s", long, 1e-6, tolerance=1e-11, judge=change)
    chaotic = _of(15, "Fig 5, 10 s", load("fig5"), np.inf, tolerance=1e-11)
    growth = hard.REFERENCE["fig5"]["dq_dq0"]
    loss = 1e-11 * np.abs(growth).max()  # what the tolerance becomes by then
    yield _slope(chaotic, growth, float(loss))
    for seconds, bound in ((1e4, 1e-9), (1e5, 1e-8)):
        ts = np.linspace(0, seconds, hard.OUTPUTS)
        swing = hard.free(hard.arm(), [0.1 - np.pi / 2, 0, 0], ts)
        change = _energy_change(swing.linkage)
        yield _of(16, f"energy, {seconds:.0e} s", swing, bound, judge=change)
    for kp in (1e4, 1e6, 1e8):
        yield _stiff(kp)
    yield HardScene(
        20, "damping of 1e6", hard.arm(), hard.START, np.linspace(0, 1, 11), _creep,
        1e-6, drive=Drive(damping=np.full(3, 1e6)), tolerance=STIFF_TOLERANCE,
        stiff=True, first_step=1e-6, most_steps=1e3,
    )  # fmt: skip
    usual = np.asarray(_tight(hard.START, np.linspace(0, 5, 11)))
    yield _scaled("links of 1 mm", 1e-3, 1e-3, usual)
    yield _scaled("links of 1 km", 1e3, 1e9, usual)
    for turns in (1e6, 1e8):
        yield _turned(turns)
