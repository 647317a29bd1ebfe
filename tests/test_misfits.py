"""Numbers, elements, states and motions of another chain are refused by name."""

import chains
import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import Hold

import fdof_jax as fj

RNG, TS = np.random.default_rng(0), [0, 0.1]
TWO, THREE = chains.random_chain("RR", RNG), chains.random_chain("RRR", RNG)
Z2, Z3, HOLD, TIP = np.zeros(2), np.zeros(3), Hold(jnp.zeros(2)), fj.Point(3, 0.1)
REST, OTHER = fj.State(Z2, Z2), fj.State(Z3, Z3)
MOVE = fj.references.JointMove(Z3, Z3, fj.references.Travel(1.0))


def motion(joints):
    rows, done = np.zeros((2, joints)), diffrax.RESULTS.successful
    stats = {"num_steps": 1, "time_reached": 0.0}
    return fj.Solution(np.zeros(2), rows, rows, stats=stats, result=done)


def refused(words, call, *given):
    with pytest.raises(ValueError, match=f"^{words}"):
        call(*given)


pd = lambda reference, kp=1: fj.PDController(kp, 1, 1, reference)
held = lambda model: fj.control.GravityFeedforward(1, 1, 1, HOLD, model)
numbers = lambda name: rf"forces\[0\]\.{name}: expected numbers for 2 joints, .*got 3"
link = lambda name: rf"forces\[0\]\.{name}.link: expected 0 .* 1 to 2, got 3"
MISFITS = {
    numbers("kp"): pd(HOLD, [1, 1, 1]),
    numbers("coefficient"): fj.JointDamper([1, 2, 3]),
    numbers("lower"): fj.forces.JointStops([-1, -1, -1], 1.0),
    numbers("command.tau"): fj.control.FirstOrderLag(fj.JointEffort([1, 2, 3]), 0.1),
    numbers("reference.start"): pd(MOVE),
    link("b"): fj.SpringDamper(fj.Point(0, 0.1), TIP),
    link("point"): fj.Wrench(TIP, [1, 0]),
    r"forces\[0\]\.joints: .* 1 to 2, got 3": fj.simulation.PrescribedMotion(3, HOLD),
    r"forces\[0\]\.model: expected the arm's own topology": held(THREE),
    r"forces\[0\]\.reference: .* 2 real numbers for 2 joi": pd(Hold(jnp.zeros(3))),
}


@pytest.mark.parametrize("words", MISFITS)
def test_elements_of_other_chains_are_refused(words):
    simulated = lambda q: fj.simulate(TWO, REST._replace(q=q), TS, (MISFITS[words],))
    for call in simulated, jax.jit(simulated):
        refused(words, call, Z2)


STATE, SOLUTION = "an array of 2 real numbers", "solution: expected a motion of 2 joint"


@pytest.mark.parametrize(
    "words, call, given",
    [
        (link("b"), fj.linearize, (REST, (MISFITS[link("b")],))),
        (
            numbers("coeff.*"),
            fj.sweep,
            (fj.State(Z2[None], Z2), TS, (fj.JointDamper(Z3),)),
        ),
        (numbers("coeff.*"), fj.joint_efforts, ((fj.JointDamper(Z3),), motion(2))),
        (numbers("coeff.*"), fj.joint_reactions, ((fj.JointDamper(Z3),), motion(2))),
        (numbers("coeff.*"), fj.analysis.equilibrium, (Z2, (fj.JointDamper(Z3),))),
        (r"forces\[0\]: .* return", fj.linearize, (REST, (lambda *_: jnp.zeros(3),))),
        (rf"state0\.q: expected {STATE}.*\(3,\)", fj.simulate, (OTHER, TS)),
        (rf"state\.q: expected {STATE}", fj.step, (OTHER, [0, 0], 0.1)),
        (rf"state\.q: expected {STATE}", fj.linearize, (OTHER,)),
        (rf"q: expected {STATE} for 2 joints", fj.analysis.equilibrium, (Z3,)),
        (rf"q: expected {STATE} for 2 joints", fj.drawing.draw_linkage, (Z3,)),
        (SOLUTION, fj.to_pandas, (motion(3),)),
        (SOLUTION, fj.to_xarray, (motion(3),)),
        (SOLUTION, fj.drawing.chrono_cyclograph, (motion(3),)),
        (SOLUTION, fj.plotting.energy_profile, (motion(3),)),
        (SOLUTION, fj.plotting.effort_profile, ((), motion(3))),
        (SOLUTION, fj.plotting.tracking_by_error, (fj.CircleTask(), motion(3))),
        (SOLUTION, fj.analysis.closed_loop_modes, ((), motion(3))),
        (SOLUTION, fj.joint_efforts, ((), motion(3))),
    ],
)
def test_what_is_of_another_chain_is_refused_at_each_door(words, call, given):
    refused(words, call, TWO, *given)


def test_a_model_is_compared_by_topology_and_no_point_is_nowhere():
    model = chains.random_chain("RP", RNG)
    assert held(model).fits(model, Z2) and not held(model).fits(TWO, Z2)
    # A link that is traced is not known to be missing.
    spring = fj.SpringDamper(fj.Point(0, 0.1), TIP, stiffness=1)
    stored = lambda spring: spring.potential_energy(Z2, TWO)
    assert np.isnan(jax.jit(stored)(spring))


@pytest.mark.parametrize(
    "name, words",
    [
        ("length", "3 real numbers for the ground and 2 moving links"),
        ("mass", "2 real numbers for 2 moving links"),
        ("com", "2x2 real numbers for 2 moving links"),
    ],
)
def test_sizes_of_a_linkage_are_refused_with_their_reason(name, words):
    fields = dict(length=[0, 1, 1], com=np.zeros((2, 2)), mass=[1, 1], inertia=[1, 1])
    with pytest.raises(ValueError, match=f"^{name}: expected an array of {words}"):
        fj.Linkage("RR", **fields | {name: np.zeros((4, 4))})
    arm = eqx.tree_at(lambda arm: getattr(arm, name), TWO, np.ones(4))
    refused(rf"linkage\.{name}: .* 2 pairs", fj.tip_position, arm, Z2)
