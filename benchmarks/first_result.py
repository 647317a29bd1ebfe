"""The first result of a process, for `compile_times`: one sample.

    python -m benchmarks.first_result CASE [FOLDER]

prints seconds as JSON. `imported` and `first` are seconds of CPU from the start of the
process to the import of the library and to the first result; `again` is the wall time
of the same call with other numbers. In a folder, `configure` keeps compiled programs.
"""

import json
import sys
import time
from collections.abc import Callable

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj

TS = np.linspace(0, 2, 201)


def pendulum() -> Callable:
    """Returns a textbook's pendulum in plain diffrax: a unit for slow machines."""
    term = diffrax.ODETerm(lambda t, y, args: jnp.stack([y[1], -9.81 * jnp.sin(y[0])]))
    control = diffrax.PIDController(rtol=1e-11, atol=1e-11)

    @jax.jit
    def run(ts):
        return diffrax.diffeqsolve(
            term, diffrax.Dopri8(), ts[0], ts[-1], 1e-3, jnp.array([1.0, 0.0]),
            saveat=diffrax.SaveAt(ts=ts), stepsize_controller=control,
        ).ys  # fmt: skip

    return lambda scale: run(scale * TS)


def _simulate(scene: fj.Scene) -> Callable:
    linkage, state0, forces, _ = scene
    return lambda scale: fj.simulate(linkage, state0, scale * TS, forces)


def fig5() -> Callable:
    return _simulate(fj.scenes.fig5())


def fig7() -> Callable:
    return _simulate(fj.scenes.fig7())


def sweep() -> Callable:
    linkage, state0, forces, _ = fj.scenes.fig5()
    starts = np.asarray(state0.q) + np.linspace(-0.1, 0.1, 256)[:, None]
    members = fj.State(starts, state0.qd)
    return lambda scale: fj.sweep(linkage, members, scale * TS, forces)


def gradient() -> Callable:
    from . import gradients

    run = gradients.compiled("forward")
    p, tolerance = gradients.parameters(1), gradients.TOLERANCE
    return lambda scale: run(p, scale * gradients.HORIZON, tolerance, np.inf)


def held() -> Callable:
    """Returns two bars with friction that sticks, stops and a payload."""
    arm, start, _, _ = fj.scenes.double_pendulum()
    forces = (
        fj.forces.JointFriction([1.0, 0.5]),
        fj.forces.HardStops([-2, -1], [2, 1], restitution=0.3),
        fj.forces.Payload(fj.Point(2, 1.0), mass=0.5, begin=0.4, end=1.2),
    )
    start = fj.State([0.0, 0.5], [0, 0])
    return _simulate(fj.Scene(arm, start, forces, 2.0))


def co_design() -> Callable:
    """Returns the derivative of a loss in lengths and gains, of motion and efforts."""
    scene = fj.scenes.two_link_circle()
    (pd,) = scene.forces
    forward = diffrax.ForwardMode()

    def loss(log):
        length = scene.linkage.length * jnp.exp(jnp.append(0, log[:2]))
        linkage, more = scene.linkage.replace(length=length), jnp.exp(log[2:])
        control = pd.replace(kp=pd.kp * more[:2], kd=pd.kd * more[2:])
        now = fj.Scene(linkage, fj.State(*pd.reference(0.0, linkage)), (control,), 2.0)
        motion = fj.simulate(now, jnp.linspace(0, 2, 101), adjoint=forward)
        efforts = fj.joint_efforts(now, motion).total
        return jnp.sum(fj.tuning.tip_errors(now, motion) ** 2) + jnp.mean(efforts**2)

    slope = jax.jit(jax.jacfwd(loss))
    return lambda scale: slope(0.01 * scale * jnp.ones(6))


def tune() -> Callable:
    run, scene = fj.tune, fj.scenes.fig7()
    return lambda scale: run(scene._replace(t1=scale * scene.t1))


CASES: dict[str, Callable] = {
    "a pendulum in plain diffrax": pendulum,
    "Fig 5": fig5,
    "Fig 7": fig7,
    "friction, stops and a payload": held,
    "sweep of 256": sweep,
    "value and gradient of six gains": gradient,
    "slope of a co-design loss": co_design,
    "tune Fig 7": tune,
}


def main() -> None:
    case, *folder = sys.argv[1:]
    fj.configure(x64=True, cache=folder[0] if folder else False)
    run = CASES[case]()
    imported = time.process_time()
    jax.block_until_ready(run(1.0))
    first = time.process_time()
    began = time.perf_counter()
    jax.block_until_ready(run(0.99))
    again = time.perf_counter() - began
    print(json.dumps({"imported": imported, "first": first, "again": again}))


if __name__ == "__main__":
    main()
