"""Derivatives of arms that rest, whose motion has no error that would bound a step.

An arm at rest obeys its linearised equations, whose matrix exponential is exact. The
linearisation is that of the equations at one instant, not of any integrator. A slide
under linear forces obeys them wherever it is: from a lively start, at rest, and after.
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import Hold
from modes import ADJOINT, LOOPS
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import fdof_jax as fj

# For `jax.grad`: by tangents in a few numbers, by the adjoint with checkpoints.
DEFAULT, FORWARD = diffrax.RecursiveCheckpointAdjoint(), diffrax.ForwardMode()
MODES = "tangents", "adjoint", "forward"
HANGING = fj.Linkage(
    "R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12],
    base_angle=-np.pi / 2,
)  # fmt: skip


class Pushes(eqx.Module):
    """Efforts that grow with the time from the first of the times to the second."""

    times: jax.Array
    rate: jax.Array

    @property
    def jump_ts(self):
        return self.times

    def __call__(self, t, q, qd, linkage):
        begin, end = self.times
        return jnp.where((begin <= t) & (t < end), self.rate * (t - begin), 0)


def changed(numbers, scene):
    """Returns arm and forces with other efforts and masses, and the start."""
    arm, forces = scene[:2]
    tau, log_mass, q0, qd0 = numbers
    arm = eqx.tree_at(lambda a: a.mass, arm, arm.mass * jnp.exp(log_mass))
    forces = eqx.tree_at(lambda f: f[0].tau, forces, forces[0].tau + tau)
    return arm, forces, fj.State(q0, qd0)


def end(numbers, scene, adjoint, rtol=None):
    """Returns a weighted sum of the last positions and velocities, and steps."""
    arm, forces, start = changed(numbers, scene)
    motion = fj.simulate(
        arm, start, jnp.stack([0.0, scene[2]]), forces,
        adjoint=adjoint, throw=False, rtol=rtol, atol=rtol,
    )  # fmt: skip
    last = jnp.concatenate([motion.q[-1], motion.qd[-1]])
    # Of a failed motion nothing may count.
    good = motion.result == diffrax.RESULTS.successful
    return jnp.where(good, scene[3] @ last, jnp.nan), motion.stats["num_steps"]


def gradients(mode):
    if mode == "forward":
        of = lambda numbers, scene: jax.jacfwd(
            lambda numbers: end(numbers, scene, FORWARD), has_aux=True
        )(numbers)
    else:
        adjoint = {"tangents": DEFAULT, "adjoint": ADJOINT}[mode]
        of = jax.grad(lambda *at: end(*at, adjoint), has_aux=True)
    return eqx.filter_jit(of, **LOOPS)


@pytest.fixture(scope="module")
def gradient():
    """Returns the gradient of `end` by each mode, each compiled once."""
    return {mode: gradients(mode) for mode in MODES}


@eqx.filter_jit
def linearised(numbers, scene):
    """Returns the rates at the start, and their derivatives in state and numbers."""

    def rates(state, numbers):
        arm, forces, (q, _) = changed(numbers, scene)
        q, qd = state[: len(q)], state[len(q) :]
        tau = sum(element(0.0, q, qd, arm) for element in forces)
        return jnp.concatenate([qd, fj.forward_dynamics(arm, q, qd, tau)])

    state = jnp.concatenate(numbers[2:])
    in_state, in_numbers = jax.jacfwd(rates, (0, 1))(state, numbers)
    return rates(state, numbers), in_state, jnp.hstack(in_numbers[:2])


def exact(numbers, scene):
    """Returns the gradient of `end`, by a matrix exponential, and the fastest rate."""
    rates, in_state, in_numbers = map(np.asarray, linearised(numbers, scene))
    assert np.abs(rates).max() < 1e-11  # at rest
    size, count = in_numbers.shape
    matrix = np.block(
        [[in_state, in_numbers], [np.zeros((count, size)), np.zeros((count, count))]]
    )
    whole = expm(float(scene[2]) * matrix)[:size]
    modes = np.linalg.eigvals(in_state)
    columns = np.hstack([whole[:, size:], whole[:, :size]])
    return np.asarray(scene[3]) @ columns, modes


def flat(gradient):
    return np.concatenate([np.asarray(part) for part in gradient])


def error(found, wanted):
    return np.linalg.norm(found - wanted) / np.linalg.norm(wanted)


# One structure for all arms of as many joints: elements of no effect have coefficients
# of 0, so that one program in each mode serves all.


def held_by(kind, rng, topology):
    """Returns a random arm at rest, which something of this kind holds or damps."""
    n, none = len(topology), np.zeros(len(topology))
    arm = fj.Linkage(
        topology, length=rng.uniform(0.3, 1, n + 1), com=rng.uniform(0.1, 0.5, (n, 2)),
        mass=rng.uniform(0.5, 2, n), inertia=rng.uniform(0.05, 0.3, n),
        base_angle=rng.uniform(-3, 3),
    )  # fmt: skip
    q = rng.uniform(-1, 1, n)
    moved = lambda qdd: fj.inverse_dynamics(arm, q, none, qdd)
    inertia = np.diag(jax.jacfwd(moved)(jnp.zeros(n)))
    damping, kp, kd, friction, stiffness = (none for _ in range(5))
    speed, touching = 0.01, rng.random(n) < 0.5
    if kind == "damper":
        damping = inertia * 10 ** rng.uniform(0, 4)
    if kind == "PD":  # critically damped and overdamped
        frequency = 10 ** rng.uniform(0.3, 1.7, n)
        kp = inertia * frequency**2
        kd = 2 * inertia * frequency * 10 ** rng.uniform(0, 1.5)
    if kind == "friction":
        friction, speed = inertia * rng.uniform(0.1, 3, n), 10 ** rng.uniform(-2.5, -1)
    if kind == "stops":
        damping, stiffness = 3 * inertia, inertia * 10 ** rng.uniform(1, 4)
    acting = (
        fj.JointDamper(damping),
        fj.PDController(kp, kd, none + np.inf, Hold(jnp.asarray(q - 0.05))),
        fj.forces.JointFriction(friction, speed=speed),
        fj.forces.JointStops(
            np.where(touching, q + 0.01, q - 1), q + 5, stiffness=stiffness + 1e-9,
            damping=0.3, smoothing=1e-3,
        ),
    )  # fmt: skip
    given = sum(np.asarray(e(0.0, jnp.asarray(q), none, arm)) for e in acting)
    balance = fj.JointEffort(np.asarray(moved(jnp.zeros(n))) - given)
    time, weights = rng.choice([0.5, 2.0, 10.0]), rng.standard_normal(2 * n)
    numbers = tuple(map(jnp.asarray, (none, none, q, none)))
    return numbers, (arm, (balance, *acting), *map(jnp.asarray, (time, weights)))


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
def test_an_arm_that_hangs_in_damping_of_any_strength(mode, gradient):
    numbers, (_, (balance, damper, *others), *_) = held_by(
        "nothing", np.random.default_rng(0), "R"
    )
    numbers = tuple(map(jnp.zeros_like, numbers))
    balance = eqx.tree_at(lambda b: b.tau, balance, jnp.zeros(1))
    # The other elements are taken from an arm in another pose, with no coefficients.
    for damping in (0.0, 1.0, 10.0, 30.0, 100.0, 1e3, 1e4):
        damper = eqx.tree_at(lambda d: d.coefficient, damper, jnp.array([damping]))
        time = jnp.array(2.0 if damping else 10.0, float)  # no weak type
        scene = HANGING, (balance, damper, *others), time, jnp.array([1.0, 0])
        wanted, _ = exact(numbers, scene)
        found, _ = gradient[mode](numbers, scene)
        assert error(flat(found), wanted) < 1e-7, damping


@pytest.mark.parametrize("kind", ["damper", "PD", "friction", "stops"])
@pytest.mark.parametrize(
    "mode",
    [MODES[0], *(pytest.param(mode, marks=pytest.mark.slow) for mode in MODES[1:])],
)
def test_one_joint_at_rest(mode, kind, gradient):
    rng = np.random.default_rng(5)
    for _ in range(4):
        numbers, scene = held_by(kind, rng, "R")
        wanted, _ = exact(numbers, scene)
        found, _ = gradient[mode](numbers, scene)
        assert error(flat(found), wanted) < 1e-6


@pytest.mark.slow
def test_members_of_a_batch_at_rest(gradient):
    rng = np.random.default_rng(7)
    kinds = "damper", "PD", "friction", "stops"
    members = [held_by(kind, rng, "R") for kind in kinds]
    numbers, scenes = jax.tree.map(lambda *rows: jnp.stack(rows), *members)
    found, _ = jax.vmap(gradient["adjoint"])(numbers, scenes)
    for k, member in enumerate(members):
        wanted, _ = exact(*member)
        assert error(flat(part[k] for part in found), wanted) < 1e-6, kinds[k]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:prismatic joints")
def test_random_arms_at_rest(gradient):
    """24 scenes of two joints, by the adjoint and in forward mode."""
    rng, solved = np.random.default_rng(2), 0
    while solved < 24:
        kind = rng.choice(["nothing", "damper", "PD", "friction", "stops"])
        # An arm of slides alone is refused.
        topology = "R" + rng.choice([*"RRP"])
        numbers, scene = held_by(kind, rng, topology)
        wanted, rates = exact(numbers, scene)
        time = float(scene[2])
        # Rounding errors make unstable arms leave their pose; many steps take minutes.
        if rates.real.max() * time > 5 or np.abs(rates).max() * time > 3e4:
            continue
        for mode in MODES[1:]:
            found, steps = gradient[mode](numbers, scene)
            assert error(flat(found), wanted) < 1e-6, (mode, kind, int(steps))
        solved += 1


@pytest.mark.slow
def test_second_derivatives_of_an_arm_at_rest():
    """The derivative in effort and damping, whose exact value is a difference."""
    rng = np.random.default_rng(5)
    numbers, scene = held_by("damper", rng, "R")

    def effort_at(damping):
        damped = eqx.tree_at(lambda s: s[1][1].coefficient, scene, damping)
        first = lambda tau: end((tau, *numbers[1:]), damped, DEFAULT)[0]
        return jax.grad(first)(numbers[0])[0]

    damping = scene[1][1].coefficient

    def wanted(change):
        damped = eqx.tree_at(lambda s: s[1][1].coefficient, scene, damping + change)
        return exact(numbers, damped)[0][0]

    h = 1e-3 * damping
    wide, near = ((wanted(k * h) - wanted(-k * h)) / (2 * k * h) for k in (2, 1))
    found = jax.jit(jax.jacfwd(effort_at), **LOOPS)(damping).item()
    assert found == pytest.approx(((4 * near - wide) / 3).item(), rel=1e-6)


# A slide with drives and a bumper: its motion is a matrix exponential.
SLIDE = fj.Linkage(
    "P", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1], gravity=0
)
TARGET, VOLTS, RESISTANCE, INDUCTANCE, CONSTANT = 0.5, (30.0, 1.0), 0.5, 0.02, 2.0
ANCHOR, REST_LENGTH = 2.0, 9.0  # the bumper is never left
ENDS = 1.0, 10.0, 100.0
BUMPERS = (0.0, 0.0), (50.0, 5.0)  # stiffness and damping


def driven(end):
    """Returns kp, ki, kd, lag, mass, start, the push's rate, begin and length, end."""
    return jnp.array([40.0, 30, 12, 0.05, 1.5, 0.3, 2, 40, end - 0.4, 0.2, end])


def driven_scene(x, bumper):
    """A PID controller behind a lag, a motor, a bumper, and a push before the end."""
    kp, ki, kd, lag, mass, q, qd, rate, begin, length, _ = x
    target = fj.references.SetPoint([TARGET])
    pid = fj.control.PIDController(kp, ki, kd, np.inf, target)
    motor = fj.control.DCMotor(
        fj.PDController(*VOLTS, np.inf, target), resistance=RESISTANCE,
        inductance=INDUCTANCE, constant=CONSTANT,
    )  # fmt: skip
    spring = fj.SpringDamper(
        fj.Point(0, 0, ANCHOR), fj.Point(1), stiffness=bumper[0], damping=bumper[1],
        rest_length=REST_LENGTH, one_sided="bumper",
    )  # fmt: skip
    push = Pushes(jnp.stack([begin, begin + length]), rate[None])
    arm = eqx.tree_at(lambda a: a.mass, SLIDE, mass[None])
    forces = fj.control.FirstOrderLag(pid, lag), motor, spring, push
    return arm, fj.State(q[None], qd[None]), forces


def last_place(x, bumper):
    arm, start, forces = driven_scene(x, bumper)
    ts = jnp.stack([0.0, x[-1]])
    motion = fj.simulate(arm, start, ts, forces, adjoint=ADJOINT)
    return motion.q[-1, 0] + 0.1 * motion.qd[-1, 0]


@jax.jit
def exact_last_place(x, bumper):
    """Of position, velocity, lagged effort, integral, current, push, its rate and 1."""
    kp, ki, kd, lag, mass, q, qd, rate, begin, length, end = x
    (stiffness, damping), (volts, per_speed) = bumper, VOLTS
    far = stiffness * (ANCHOR - REST_LENGTH)
    rows = [
        [0, 1, 0, 0, 0, 0, 0, 0],
        [-stiffness, -damping, 1, 0, CONSTANT, 1, 0, far],
        [-kp, -kd, -1, 1, 0, 0, 0, kp * TARGET],
        [-ki, 0, 0, 0, 0, 0, 0, ki * TARGET],
        [-volts, -per_speed - CONSTANT, 0, 0, -RESISTANCE, 0, 0, volts * TARGET],
        [0, 0, 0, 0, 0, 0, 1, 0],
    ]
    rows = jnp.stack([jnp.stack([jnp.asarray(a, float) for a in r]) for r in rows])
    rows = rows / jnp.stack([1.0, mass, lag, 1.0, INDUCTANCE, 1.0])[:, None]
    matrix = jnp.concatenate([rows, jnp.zeros((2, 8))])
    after = lambda time: jax.scipy.linalg.expm(time * matrix, max_squarings=40)
    state = jnp.zeros(8).at[:2].set(jnp.stack([q, qd])).at[7].set(1)
    state = (after(begin) @ state).at[6].set(rate)
    state = (after(length) @ state).at[5:7].set(0)
    state = after(end - begin - length) @ state
    return state[0] + 0.1 * state[1]


exact_slope = jax.jit(jax.grad(exact_last_place))


@pytest.mark.slow
def test_a_slide_that_comes_to_rest_and_is_pushed_again():
    """Derivatives in gains, lag, mass, start, push and times."""
    slope = jax.jit(jax.grad(last_place), **LOOPS)
    for end in ENDS:
        for bumper in map(jnp.array, BUMPERS):
            wanted = exact_slope(driven(end), bumper)
            assert error(slope(driven(end), bumper), wanted) < 1e-8, (end, bumper)


def damped_links(x):
    """Two links with rounded friction, a PD controller, and stops that hold one."""
    kp, kd, mass, level, q, qd = x
    arm = fj.Linkage(
        "RR", length=[0, 1, 1], com=[[0.5, 0]] * 2, mass=[1, 1], inertia=[1 / 12] * 2,
        base_angle=-np.pi / 2,
    )  # fmt: skip
    with_first = lambda first, second: jnp.stack([first, jnp.asarray(second)])
    arm = eqx.tree_at(lambda a: a.mass, arm, with_first(mass, 1.2))
    target = fj.references.SetPoint([0.3, -0.2])
    forces = (
        fj.PDController(with_first(kp, 20.0), with_first(kd, 3.0), np.inf, target),
        fj.forces.JointFriction(with_first(level, 0.5), speed=0.01),
        fj.forces.JointStops(
            [-1, -0.3], [0.1, 1], stiffness=1e3, damping=0.3, smoothing=1e-3
        ),
    )
    return arm, fj.State(with_first(q, 0.2), with_first(qd, 2.0)), forces


@jax.jit
def varied_rates(rows, x):
    """Returns the rates of a state and of its derivatives in x, which are rows."""

    def rates(state, x):
        arm, _, forces = damped_links(x)
        q, qd = jnp.split(state, 2)
        tau = sum(element(0.0, q, qd, arm) for element in forces)
        return jnp.concatenate([qd, fj.forward_dynamics(arm, q, qd, tau)])

    state, *varied = rows.reshape(len(x) + 1, -1)
    in_state, in_x = jax.jacfwd(rates, (0, 1))(state, x)
    varied = jnp.stack(varied) @ in_state.T + in_x.T
    return jnp.concatenate([rates(state, x), varied.ravel()])


@pytest.mark.slow
def test_links_that_friction_and_a_stop_bring_to_rest():
    """Against SciPy's integration of the variational equations."""
    weights = np.array([1, -2, 0.1, 0.1])

    def last(x, end):
        arm, start, forces = damped_links(x)
        ts = jnp.stack([0.0, end])
        motion = fj.simulate(arm, start, ts, forces)
        return weights @ jnp.concatenate([motion.q[-1], motion.qd[-1]])

    slope, x = jax.jit(jax.grad(last), **LOOPS), jnp.array([40, 6, 1, 1, -0.5, 1.0])
    start = lambda x: jnp.concatenate(damped_links(x)[1])
    rows = np.concatenate([start(x), jax.jacfwd(start)(x).T.ravel()])
    for end in (1.0, 10.0):
        found = solve_ivp(
            lambda t, rows: np.asarray(varied_rates(rows, x)), (0, end), rows, "LSODA",
            rtol=1e-11, atol=1e-13, max_step=0.05,
        )  # fmt: skip
        wanted = found.y[:, -1].reshape(len(x) + 1, -1)[1:] @ weights
        assert error(slope(x, end), wanted) < 1e-7


@pytest.mark.slow
def test_an_implicit_method_in_strong_damping():
    """A pendulum that hangs, in dampers that take explicit methods 1e3 to 1e8 steps."""
    settings = dict(solver=diffrax.Kvaerno5(), dt0=1e-6, rtol=1e-9, atol=1e-9)

    def last(tau, damping):
        forces = (fj.JointDamper(damping), fj.JointEffort(tau))
        motion = fj.simulate(
            HANGING, fj.State([0.0], [0.0]), [0, 100.0], forces, **settings
        )
        return motion.q[-1, 0], motion.stats["num_steps"]

    slope = jax.jit(jax.grad(last, has_aux=True), **LOOPS)
    inertia, stiffness = 1 / 3, 9.81 / 2
    for damping in (30.0, 1e3, 1e5, 1e6):
        linear = [[0, 1, 0], [-stiffness / inertia, -damping / inertia, 1 / inertia]]
        wanted = expm(100.0 * np.array([*linear, [0, 0, 0]]))[0, 2]
        found, steps = slope(jnp.zeros(1), damping)
        assert found.item() == pytest.approx(wanted, rel=1e-6)
        assert steps < 200


@pytest.mark.slow
def test_numbers_of_very_different_size_have_exact_derivatives():
    """On the second of two slides at right angles; the first one does not move it."""
    arm = fj.Linkage(
        "PP", length=[0, 0, 1], com=[[0, 0]] * 2, mass=[1, 1], inertia=[0.1, 0.1],
        locked=[np.pi / 2, 0], gravity=0,
    )  # fmt: skip
    damper = fj.JointDamper([0.1, 100.0])

    def second(tau, repelled, place, end, adjoint=DEFAULT):
        push = lambda t, q, qd, linkage: repelled * q * jnp.array([1.0, 0.0])
        start, ts = fj.State(place, jnp.zeros(2)), jnp.stack([0.0, end])
        forces = push, damper, fj.JointEffort(tau)
        return fj.simulate(arm, start, ts, forces, adjoint=adjoint).q[-1, 1]

    slope = jax.jit(jax.grad(second), **LOOPS)
    exact = lambda t: (t - (1 - np.exp(-100 * t)) / 100) / 100
    for tau in (1e-3, 1e-9, 6e-17, 0.0):
        found = slope(jnp.array([1.0, tau]), 0.0, jnp.full(2, 0.5), 2.0)
        np.testing.assert_allclose(found, [0, exact(2.0)], rtol=1e-7, atol=1e-15)
    # The derivative of the first position in its effort grows to 1e12.
    # A probe grows with it, and would hide the other joint.
    forward = jax.jacfwd(lambda *at: second(*at, FORWARD))
    for of in (slope, jax.jit(forward, **LOOPS)):
        found = of(jnp.zeros(2), 18.0, jnp.zeros(2), 10.0)
        np.testing.assert_allclose(found[1], exact(10.0), rtol=1e-7)


@pytest.mark.slow
def test_a_motion_that_keeps_moving_takes_hardly_more_steps():
    """In the six gains of Fig 7: the counts of docs/gradients.md."""
    scene = fj.scenes.fig7()

    def end(gains, tolerance):
        controller = scene.forces[0].replace(kp=gains[0], kd=gains[1])
        motion = fj.simulate(
            scene.linkage, scene.state0, [0, 4.0], (controller,), rtol=tolerance,
            atol=tolerance,
        )  # fmt: skip
        return jnp.sum(motion.q[-1]), motion.stats["num_steps"]

    gains = jnp.stack([scene.forces[0].kp, scene.forces[0].kd])
    slope = jax.jit(jax.grad(end, has_aux=True), **LOOPS)
    for tolerance, more in ((1e-11, 1.1), (1e-8, 1.15)):
        assert slope(gains, tolerance)[1] <= more * end(gains, tolerance)[1]
