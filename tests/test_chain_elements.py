"""Elements, controllers and analysis on a chain of four pairs, one of them fixed."""

from types import SimpleNamespace

import chains
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import SHORT

import fdof_jax as fj
from fdof_jax.analysis.tracking import relative_demands

pytestmark = pytest.mark.slow
TOPOLOGY = "RPFR"


def elements_of(n, gain, hold, ends):
    """Returns elements by name; `ends`: two points that springs and cylinders join."""
    rows = gain, gain, np.inf, hold
    return dict(
        pd=fj.PDController(*rows),
        damper=fj.JointDamper(gain),
        spring=fj.SpringDamper(*ends, stiffness=30.0, rest_length=0.4),
        tension=fj.forces.Tension(*ends, 3.0),
        stops=fj.forces.JointStops(-0.1, 0.1, stiffness=50.0),
        wrench=fj.Wrench(ends[1], [3.0, -2.0], 0.5),
        gravity=fj.control.GravityFeedforward(*rows),
        torque=fj.control.ComputedTorque(*rows),
        actuator=fj.LinearActuator(
            *ends, force=50.0, mass=[1.2, 0.7], com=[0.2, 0.3], inertia=[0.05, 0.03]
        ),
        armature=fj.forces.Armature(gain),
    )


@eqx.filter_jit
def everything(chain, q, qd, qdd, gain, hold, ends):
    """Returns what the tests compare: efforts, potentials' slopes and dynamics."""
    still = jnp.zeros_like(q)
    elements = elements_of(q.size, gain, hold, ends)
    effort = {k: element(0.0, q, qd, chain) for k, element in elements.items()}
    at_rest = {k: elements[k](0.0, q, still, chain) for k in ("spring", "tension")}
    at_rest["stops"] = elements["stops"](0.0, q, still, chain)
    energy = lambda element: lambda q: element.potential_energy(q, chain)
    slope = {k: jax.grad(energy(elements[k]))(q) for k in at_rest}
    weight = jax.grad(lambda q: fj.energy(chain, q, still)[1])(q)
    masses = elements["actuator"], elements["armature"]
    tau = fj.inverse_dynamics(chain, q, qd, qdd, masses)
    total = lambda q, qd: sum(fj.energy(chain, q, qd, masses))
    length = lambda q: jnp.linalg.norm(
        jnp.subtract(*(p.position(chain, q) for p in ends))
    )
    tip = lambda q: ends[1].position(chain, q)
    forced = lambda y, tau: fj.forward_dynamics(
        chain, y[0], y[1], tau + elements["damper"](0.0, *y, chain)
    )
    direction = jnp.stack([q + 0.3, qd - 0.2])
    direction = jnp.where(jnp.stack([gain, gain]) > 0, direction, 0)
    linear = fj.linearize(chain, fj.State(q, qd), (elements["damper"],))
    return dict(
        effort=effort,
        at_rest=at_rest,
        slope=slope,
        weight=weight,
        holding=fj.analysis.holding_efforts(chain, q),
        tau=tau,
        back=fj.forward_dynamics(chain, q, qd, tau, masses),
        own_tau=fj.inverse_dynamics(chain, q, qd, qdd),
        power=jax.jvp(total, (q, qd), (qd, qdd))[1],
        armature=fj.inverse_dynamics(chain, q, qd, qdd, masses[1:]),
        lever=jax.grad(length)(q),
        columns=jax.jacfwd(tip)(q),
        turning=fj.tip_jacobian(chain, q)[2],
        controlled=fj.forward_dynamics(chain, q, qd, effort["torque"]),
        regressor=fj.analysis.regressor(chain, q, qd, qdd),
        parameters=fj.analysis.inertial_parameters(chain),
        linear=linear,
        slopes=jax.jvp(forced, (jnp.stack([q, qd]), still), (direction, qdd))[1],
        direction=direction,
    )


@pytest.fixture(scope="module")
def case():
    """A chain, its state and gains, and results; fixed pairs are given odd values."""
    n, real = len(TOPOLOGY), chains.moving(TOPOLOGY)
    rng = np.random.default_rng(n)
    chain = chains.random_chain(TOPOLOGY, rng)
    q, qd, qdd = jnp.asarray(np.where(real, rng.normal(size=(3, n)), 0))
    gain, target = jnp.asarray(rng.uniform(1, 2, (2, n)))
    hold = chains.Hold(target)
    ends = fj.Point(0, -1.0, 0.5), fj.Point(n, 0.3, 0.2)
    found = everything(chain, q, qd, qdd, gain, hold, ends)
    found = jax.tree.map(np.asarray, found)
    return SimpleNamespace(**locals())


def same(found, expected, tolerance=1e-10):
    np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance)


def test_potentials_are_those_of_the_forces(case):
    for name, effort in case.found["at_rest"].items():
        same(np.where(case.real, effort, 0), -case.found["slope"][name] * case.real)
        assert np.abs(effort).max() > 0.1


def test_loads_do_the_work_of_their_points(case):
    effort, real = case.found["effort"], case.real
    moved = 3 * case.found["columns"][0] - 2 * case.found["columns"][1]
    same(np.where(real, effort["wrench"], 0), moved + 0.5 * case.found["turning"])
    same(np.where(real, effort["actuator"], 0), 50 * case.found["lever"])


def test_masses_of_elements_enter_the_equations(case):
    found = case.found
    same(found["back"], case.qdd)
    same(found["tau"] @ case.qd, found["power"])
    rotors = np.where(case.real, case.gain * case.qdd, 0)
    same(found["armature"] - found["own_tau"], rotors)


def test_controllers_with_a_model(case):
    found, real = case.found, case.real
    more = found["effort"]["gravity"] - found["effort"]["pd"]
    same(np.where(real, more, 0), found["holding"])
    same(found["holding"], found["weight"])
    error = case.gain * (case.target - case.q) - case.gain * case.qd
    same(found["controlled"], np.where(real, error, 0))


def test_regressor_gives_the_inverse_dynamics(case):
    found = case.found
    same(np.tensordot(found["regressor"], found["parameters"], 2), found["own_tau"])


def test_linearization_is_the_derivative(case):
    (A, B), n, real = case.found["linear"], len(case.q), case.real
    change = A @ case.found["direction"].ravel() + B @ case.qdd
    same(change[n:], case.found["slopes"])
    same(change[:n], np.where(real, case.found["direction"][1], 0))
    assert (A[:, np.tile(~real, 2)] == 0).all()


def test_equilibrium_is_held_by_the_controller(case):
    pd = fj.PDController(500 * case.gain, 1.0, np.inf, case.hold)
    guess = np.where(case.real, case.target, 7.0)
    q = fj.analysis.equilibrium(case.chain, guess, (pd,))
    same(np.asarray(q)[~case.real], 0)
    held = fj.analysis.holding_efforts(case.chain, q)
    same(np.where(case.real, pd(0.0, q, 0 * q, case.chain), 0), held, 1e-8)


def test_bearings_carry_the_weight_at_rest_and_change_the_momentum(case):
    chain, q, qd, n = case.chain, case.q, case.qd, len(case.q)
    load = lambda *values: fj.Wrench(fj.Point(n, 0.2, 0.1), *values)
    others = fj.JointDamper(case.gain), fj.JointEffort(case.found["holding"])
    one = lambda start, forces: fj.simulate(chain, start, [0, 0.01], forces, **SHORT)
    forces = load([0.0, 0.0], 0.0), *others
    still = one(fj.State(q, 0 * qd), forces)
    reactions = fj.joint_reactions(chain, forces, still)[0]
    mass, gravity = np.asarray(chain.mass), float(chain.gravity)
    centers, joints = fj.mass_centers(chain, q), fj.joint_positions(chain, q)
    for k in range(n):
        lever = centers[k:, 0] - joints[k, 0]
        weight = gravity * mass[k:]
        same(reactions[k], [0, weight.sum(), weight @ lever], 1e-8)

    forces = load([3.0, -2.0], 0.5), *others
    motion = one(fj.State(q, qd), forces)
    reactions = fj.joint_reactions(chain, forces, motion)[0]
    efforts = fj.joint_efforts(chain, forces, motion)
    assert (np.asarray(efforts.elements)[..., ~case.real] == 0).all()
    qdd = fj.forward_dynamics(chain, q, qd, efforts.total[0])
    momentum = lambda q, qd: (
        mass @ jax.jvp(lambda q: fj.mass_centers(chain, q), (q,), (qd,))[1]
    )
    _, change = jax.jvp(momentum, (q, qd), (qd, qdd))
    carried = np.array([-3, 2 + gravity * mass.sum()])
    same(reactions[0, :2], change + carried, 1e-8)
    turns = np.asarray(chain.ef)[1::2] == 1
    own = (efforts.elements[1] + efforts.elements[2])[0]
    same(reactions[turns, 2], own[turns], 1e-8)


def test_prescribed_joints_follow_their_reference(case):
    chain, q = case.chain, case.q
    move = fj.references.JointMove(
        q, q + 1, fj.references.Travel(1.0, profile="harmonic")
    )
    # A fixed pair among the joints is ignored.
    forces = fj.simulation.PrescribedMotion((2, 3), move), fj.JointDamper(case.gain)
    ts = [0, 0.1, 0.2]
    motion = fj.simulate(chain, fj.State(q, 0 * q), ts, forces, rtol=1e-9)
    assert (np.asarray(motion.q)[:, ~case.real] == 0).all()
    efforts = fj.joint_efforts(chain, forces, motion)
    both = lambda t: move(t, chain)
    for k, t in enumerate(motion.ts):
        (position, _), (_, demanded) = jax.jvp(both, (t,), (1.0,))
        same(motion.q[k, 1], position[1])
        state = motion.q[k], motion.qd[k]
        qdd = fj.forward_dynamics(chain, *state, efforts.total[k])
        same(qdd[1], demanded[1], 1e-8)
    assert np.count_nonzero(efforts.elements[0, 1]) == 1


def test_sampled_control_steps_and_sweeps_agree(case):
    chain, real = case.chain, case.real
    pd = fj.PDController(case.gain, case.gain, 5.0, case.hold)
    start = fj.State(case.q, case.qd)
    sampled = fj.simulate_sampled(chain, start, pd, 0.05, 2, **SHORT)
    state = start
    for tau in sampled.tau:
        same(np.where(real, pd(0.0, *state, chain), 0) - tau, 0)
        state = fj.step(chain, state, tau, 0.05, **SHORT)
    same(state.q, sampled.q[-1])
    same(state.qd, sampled.qd[-1])
    motion = sampled.ts, sampled.q, sampled.qd
    rows = fj.Solution(*motion, stats={}, result=sampled.result)
    weak = fj.PDController(case.gain, case.gain, 1e-6, case.hold)
    at_limit = np.asarray(jnp.abs(relative_demands(weak, chain, rows)) > 1)
    assert at_limit[:, real].any() and not at_limit[:, ~real].any()
    both = fj.State(*(jnp.stack([a, 1.1 * a]) for a in start))
    hold = (fj.JointEffort(sampled.tau[0]),)
    swept = fj.sweep(chain, both, [0, 0.05], hold, **SHORT)
    same(swept.q[0, -1], sampled.q[1])
    assert (np.asarray(swept.q)[..., ~real] == 0).all()


def test_drives_pass_on_their_commands(case):
    chain, q, qd, target = case.chain, case.q, case.qd, case.target
    pid = fj.control.PIDController(case.gain, case.gain, case.gain, np.inf, case.hold)
    command, rate = pid(0.0, q, qd, chain, pid.initial_state(chain))
    same(command, case.gain * (target - q - qd))
    same(rate, case.gain * (target - q))
    lag = fj.control.FirstOrderLag(pid, 0.1)
    effort, rate = lag(0.0, q, qd, chain, lag.initial_state(chain))
    same(effort, 0)
    same(rate.own, 10 * command)
    limited = fj.control.SpeedLimit(pid, stall=1e6, no_load=1e9)
    same(limited(0.0, q, qd, chain, limited.initial_state(chain))[0], command, 1e-8)
    motor = fj.control.DCMotor(pid, resistance=2.0, inductance=0.5, constant=0.4)
    _, rate = motor(0.0, q, qd, chain, motor.initial_state(chain))
    same(rate.own, (command - 0.4 * qd) / 0.5)
    motion = fj.simulate(chain, fj.State(q, qd), [0, 0.02], (lag,), **SHORT)
    efforts = fj.joint_efforts(chain, (lag,), motion).total[-1]
    same(efforts, np.where(case.real, motion.own[0].own[-1], 0))
