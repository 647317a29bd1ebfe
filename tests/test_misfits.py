"""Numbers, elements, states and motions of another chain are refused by name."""

import chains
import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj

RNG = np.random.default_rng(0)
TWO, THREE = chains.random_chain("RR", RNG), chains.random_chain("RRR", RNG)
ZEROS, TS = np.zeros(2), [0, 0.1]
REST = fj.State(ZEROS, ZEROS)
BOTH = fj.State(np.zeros((2, 2)), np.zeros((2, 2)))
HOLD = chains.Hold(jnp.zeros(2))
MOVE = fj.references.JointMove([0] * 3, [1] * 3, fj.references.Travel(1.0))


def motion(joints):
    return fj.Solution(
        *(np.zeros(2), np.zeros((2, joints)), np.zeros((2, joints))),
        stats={"num_steps": 1, "time_reached": 0.0},
        result=diffrax.RESULTS.successful,
    )


def refused(words, call, *given):
    with pytest.raises(ValueError, match=f"^{words}"):
        call(*given)


pd = lambda reference, kp=1: fj.PDController(kp, 1, 1, reference)
OF_THREE = {
    "kp": pd(HOLD, [1, 1, 1]),
    "coefficient": fj.JointDamper([1, 2, 3]),
    "tau": fj.JointEffort([1, 2, 3]),
    "inertia": fj.forces.Armature([1, 2, 3]),
    "lower": fj.forces.JointStops([-1, -1, -1], 1.0),
    "command.tau": fj.control.FirstOrderLag(fj.JointEffort([1, 2, 3]), 0.1),
    "reference.start": pd(MOVE),
}


@pytest.mark.parametrize("name", OF_THREE)
def test_elements_of_other_chains_are_refused(name):
    words = rf"forces\[0\]\.{name}: expected numbers for 2 joints, .*got 3"
    forces = (OF_THREE[name],)
    simulated = lambda q: fj.simulate(TWO, REST._replace(q=q), TS, forces)
    refused(words, simulated, ZEROS)
    refused(words, jax.jit(simulated), ZEROS)
    if not name.startswith("command"):  # of a state, which has no linearization
        refused(words, fj.linearize, TWO, REST, forces)


AT_EACH_DOOR = {
    r"b\.link: expected 0 .* 1 to 2, got 3": fj.SpringDamper(
        fj.Point(0, 0.1), fj.Point(3, 0.1)
    ),
    "joints: expected 1 to 2, got 3": fj.simulation.PrescribedMotion(3, HOLD),
    "model: expected the arm's own topology": fj.control.GravityFeedforward(
        *(1, 1, 1, HOLD), THREE
    ),
    r"inertia: .* 2 joints": OF_THREE["inertia"],
}


@pytest.mark.parametrize("fault", AT_EACH_DOOR)
def test_values_of_other_chains_are_refused_at_each_door(fault):
    forces = (AT_EACH_DOOR[fault],)
    batch = jax.tree.map(lambda leaf: np.stack([leaf] * 2), TWO)
    simulated = lambda arm: fj.simulate(arm, REST, TS, forces)
    for call, *given in (
        (fj.sweep, TWO, BOTH, TS, forces),
        (fj.sweep, batch, REST, TS, forces),
        (jax.jit(simulated), TWO),
        (fj.linearize, TWO, REST, forces),
        (fj.joint_efforts, TWO, forces, motion(2)),
        (fj.joint_reactions, TWO, forces, motion(2)),
        (fj.analysis.equilibrium, TWO, ZEROS, forces),
        (fj.energy, TWO, ZEROS, ZEROS, forces),
        (fj.forward_dynamics, TWO, ZEROS, ZEROS, ZEROS, forces),
    ):
        refused(rf"forces\[0\]\.{fault}", call, *given)


def test_states_and_links_of_other_chains_are_refused():
    three = fj.State(np.zeros(3), np.zeros(3))
    words = "expected an array of 2 real numbers"
    refused(rf"state0\.q: {words}.*\(3,\)", fj.simulate, TWO, three, TS)
    refused(rf"state\.q: {words}", fj.step, TWO, three, [0, 0], 0.1)
    refused(rf"state\.q: {words}", fj.linearize, TWO, three)
    for call in fj.analysis.equilibrium, fj.drawing.draw_linkage, fj.tip_position:
        refused(rf"q: {words} for 2 joints", call, TWO, np.zeros(3))
    point = fj.Point(3, 0.1)
    for element in (fj.Wrench(point, [1, 0]), fj.LinearActuator(fj.Point(0), point)):
        words = r"forces\[0\]\..*link: expected 0 .* 1 to 2, got 3"
        refused(words, fj.simulate, TWO, REST, TS, (element,))


@pytest.mark.slow
def test_what_elements_return_is_compared_with_the_chain():
    hold = chains.Hold(jnp.zeros(3))
    words = r"forces\[0\]\.reference: expected an array of 2 real numbers for 2 joints"
    refused(words, fj.simulate, TWO, REST, TS, (pd(hold),))
    words = r"forces\[0\]\.reference\.start: expected"
    refused(words, fj.sweep, TWO, BOTH, TS, (pd(MOVE),))
    plain = (lambda t, q, qd, linkage: jnp.zeros(3),)
    words = r"forces\[0\]: expected it to return"
    refused(words, fj.linearize, TWO, REST, plain)
    refused(words, fj.analysis.equilibrium, TWO, ZEROS, plain)
    line = fj.references.Line([9, 0], [9, 1])
    far = fj.TipTask(line, fj.references.Travel(1.0), orientation=None)
    refused(".*reach on branch", fj.simulate, TWO, REST, TS, (pd(far),))


def test_a_model_is_compared_by_topology_and_no_point_is_nowhere():
    model = chains.random_chain("RP", RNG)
    control = fj.control.GravityFeedforward(1, 1, 1, HOLD, model)
    words = r"forces\[0\]\.model: expected the arm"
    refused(words, fj.linearize, TWO, REST, (control,))
    assert control.fits(model, np.zeros(1)) and not control.fits(TWO, np.zeros(1))
    # A link that is traced is not known to be missing.
    spring = fj.SpringDamper(fj.Point(0, 0.1), fj.Point(3, 0.1), stiffness=1)
    stored = lambda spring: spring.potential_energy(np.zeros(2), TWO)
    assert np.isnan(jax.jit(stored)(spring))


def test_motions_of_other_chains_are_refused():
    other = motion(3)
    for call, *given in (
        (fj.to_pandas, TWO, other),
        (fj.to_xarray, TWO, other),
        (fj.drawing.chrono_cyclograph, TWO, other),
        (fj.plotting.energy_profile, TWO, other),
        (fj.plotting.effort_profile, TWO, (), other),
        (fj.plotting.tracking_by_error, TWO, fj.CircleTask(), other),
        (fj.analysis.closed_loop_modes, TWO, (), other),
        (fj.joint_efforts, TWO, (), other),
    ):
        refused("solution: expected a motion of 2 joint", call, *given)
    grid = {"a": (TWO, other)}
    refused(r"motions\['a'\]: expected a motion", fj.drawing.topology_grid, grid)


def test_sizes_of_a_linkage_are_refused_with_their_reason():
    fields = dict(length=[0, 1, 1], com=np.zeros((2, 2)), mass=[1, 1], inertia=[1, 1])
    for name, words in (
        ("length", "3 real numbers for the ground and 2 moving links"),
        ("mass", "2 real numbers for 2 moving links"),
        ("com", "2x2 real numbers for 2 moving links"),
    ):
        with pytest.raises(ValueError, match=f"^{name}: expected an array of {words}"):
            fj.Linkage("RR", **fields | {name: np.zeros((4, 4))})
    for name, value in dict(mass=np.ones(3), length=np.ones(4), locked=1.0).items():
        arm = eqx.tree_at(lambda arm, name=name: getattr(arm, name), TWO, value)
        for call in fj.tip_position, jax.jit(fj.tip_position):
            refused(rf"linkage\.{name}: .* 2 pairs", call, arm, np.zeros(2))
