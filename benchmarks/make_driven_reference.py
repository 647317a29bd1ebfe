"""Makes tests/hard/driven_reference.json: motions under control, and extreme ones.

Needs heyoka and SciPy (the extra `benchmark`) and some minutes on one core:

    python -m benchmarks.make_driven_reference

The equations are those of `make_reference`, with efforts that depend on the state
instead of constant ones. Controlled motions are integrated by Taylor series in 80-bit
numbers (19 digits, on x86), piece by piece where efforts jump. Derivatives are
differences over 1e-5. The saturated motion is computed by SciPy's DOP853 at a tolerance
of 1e-12.
"""

import json
from functools import cache

import heyoka as hy
import numpy as np
from scipy.integrate import solve_ivp

from .make_reference import PARAMETERS, PATH, as_text, lagrange, motion

# Links of 1 m and 1 kg: those of the heavy tips with another tip.
USUAL = json.loads(PATH.read_text())["heavy-tip-1e3"] | dict(mass=[1.0] * 3, t1=5.0)
TARGET = [-0.4, 0.2, 0.3]  # what the controllers hold [rad]
STIFFNESSES = [1e4, 1e6, 1e8]
real = np.longdouble


@cache
def controlled():
    """Returns an integrator of the usual arm under kp (target - q) - kd qd + effort."""
    count, state, rates = lagrange("RRR")
    sizes = [np.size(USUAL[name]) for name in PARAMETERS]
    first = int(sum(sizes[: PARAMETERS.index("effort")]))
    kp, targets = hy.par[count], [hy.par[count + 1 + k] for k in range(3)]
    spring = {
        hy.par[first + k]: hy.par[first + k] + kp * (targets[k] - state[k])
        for k in range(3)
    }
    rates = hy.subs(rates, spring)
    return hy.taylor_adaptive(
        list(zip(state, rates)),
        np.zeros(6, real),
        pars=np.zeros(count + 4, real),
        fp_type=real,
        compact_mode=True,
    )


def hold(state, t0, ts, kp, kd, target=TARGET, effort=(0.0, 0.0, 0.0)):
    """Returns the states at `ts` from `state` at `t0`."""
    integrator = controlled()
    scene = USUAL | dict(effort=effort)
    values = sum((list(map(real, np.ravel(scene[n]))) for n in PARAMETERS[:-1]), [])
    integrator.pars[:] = [*values, *[kd] * 3, kp, *map(real, target)]
    integrator.state[:] = state
    integrator.time = real(t0)
    rows = []
    for t in ts:
        integrator.propagate_until(real(t))
        rows.append(integrator.state.copy())
    return np.stack(rows)


def start():
    return [*map(real, USUAL["q0"]), *map(real, USUAL["qd0"])]


def doubles(array):
    return np.asarray(array).astype(float).tolist()


def stiff(kp):
    """Returns positions and their derivatives in log kp with kd = 2 sqrt(kp)."""
    ts = np.linspace(0, 1, 11)[1:]

    def positions(shift):
        gain = real(kp) * (1 + shift)
        return hold(start(), 0, ts, gain, 2 * gain**0.5)[:, :3]

    h = real(1e-5)
    slope = (positions(h) - positions(-h)) / (2 * h)
    return dict(ts=ts.tolist(), q=doubles(positions(real(0))), dq_dlogkp=doubles(slope))


def stepping():
    """The target moves by 0.2 rad at 1, 2 and 3 s."""
    state, rows = start(), []
    for k, (t0, t1) in enumerate([(0, 1), (1, 2), (2, 3), (3, 5)]):
        ts = np.arange(2 * t0 + 1, 2 * t1 + 1) / 2
        target = [0.2 * k - 0.3] * 3
        states = hold(state, t0, ts, real(200), real(30), target)
        state = list(states[-1])
        rows.append(states[:, :3])
    rows = np.concatenate(rows)
    return dict(ts=(np.arange(1, 11) / 2).tolist(), q=doubles(rows))


def pulse():
    """Returns a motion under gravity and a pulse of 1e5 N m for 1 us at 7.3 s."""
    zero = real(0)
    begin, end = 7.3, 7.3 + 1e-6
    before = hold(start(), 0, [4.0, begin], zero, zero)
    after = hold(list(before[-1]), begin, [end], zero, zero, effort=(1e5, 0.0, 0.0))
    last = hold(list(after[-1]), end, [8.0], zero, zero)
    q = np.stack([before[0, :3], last[0, :3]])
    return dict(ts=[4.0, 8.0], q=doubles(q))


def saturated():
    """Returns the mean squared distance from the target, over 2001 times in 2 s.

    kp = 1e6, kd = 2e3, efforts within +-50 N m.
    """
    count, state, rates = lagrange("RRR")
    function = hy.cfunc(rates[3:], state)
    sizes = [np.size(USUAL[name]) for name in PARAMETERS]
    first = int(sum(sizes[: PARAMETERS.index("effort")]))
    pars = np.concatenate([np.ravel(USUAL[name]) for name in PARAMETERS]).astype(float)

    def field(t, y):
        effort = 1e6 * (np.array(TARGET) - y[:3]) - 2e3 * y[3:]
        pars[first : first + 3] = np.clip(effort, -50, 50)
        return np.concatenate([y[3:], function(y, pars=pars)])

    means = []
    for tolerance in (1e-12, 1e-13):
        solution = solve_ivp(
            field,
            (0, 2),
            [*USUAL["q0"], *USUAL["qd0"]],
            method="DOP853",
            t_eval=np.linspace(0, 2, 2001),
            rtol=tolerance,
            atol=tolerance,
        )
        square = np.sum((solution.y[:3].T - TARGET) ** 2, axis=1)
        means.append(float(square.mean()))
        print(tolerance, means[-1], solution.nfev)
    return dict(mean_square=means[0], at_tighter=means[1])


def free(changes):
    """Returns motions like those of `make_reference`, at its 21 times."""
    scene = USUAL | changes
    return scene | dict(q=doubles(motion(scene, bits=200)[:, :3]))


def main():
    made = {"heavy-tip-1e9": free(dict(mass=[1.0, 1.0, 1e9], t1=2.0))}
    made["swing"] = free(dict(q0=[-1.2707963267948966, 0.0, 0.0], t1=10.0))
    made["saturated"] = saturated()
    made["stepping"] = stepping()
    made["pulse"] = pulse()
    path = PATH.with_name("driven_reference.json")
    for kp in STIFFNESSES:
        print(kp, flush=True)
        made[f"stiff-{kp:.0e}"] = stiff(kp)
        path.write_text(as_text(made))


if __name__ == "__main__":
    main()
