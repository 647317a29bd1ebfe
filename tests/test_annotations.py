"""The shapes in annotations are those of the values, for arms of any size."""

import inspect
import typing

import control
import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from beartype import BeartypeConf, beartype
from elements import SHORT
from jaxtyping import AbstractArray, jaxtyped
from test_package import NAMESPACES

import fdof_jax as fj

conf = BeartypeConf(is_pep484_tower=True)  # an int is a float
checked = jaxtyped(typechecker=beartype(conf=conf))


def arm(topology):
    n = len(topology)
    return fj.Linkage(
        topology, length=[0.1] * (n + 1), com=[[0.5, 0.1]] * n, mass=[1] * n,
        inertia=[0.1] * n,
    )  # fmt: skip


# Three pairs for the paper's equations, and another number with a fixed pair.
ARMS = arm("RPR"), arm("PRFR")


def calls(linkage):
    """Returns arguments for the public functions whose shapes are annotated."""
    n = linkage.mass.size
    q = jnp.full(n, 0.1)
    motion = fj.Solution(
        *(jnp.zeros(2), jnp.ones((2, n)), jnp.ones((2, n))),
        stats={}, result=diffrax.RESULTS.successful,
    )  # fmt: skip
    scene = fj.Scene(linkage, fj.State(q, q), (PD,), 1.0)
    found = {
        fj.energy: (linkage, q, q, MASSES),
        fj.forward_dynamics: (linkage, q, q, q, MASSES),
        fj.inverse_dynamics: (linkage, q, q, q, MASSES),
        fj.bias_force: (linkage, q, q, MASSES),
        fj.mass_matrix: (linkage, q, MASSES),
        fj.link_energies: (linkage, q, q),
        fj.paper.to_chain: (linkage, q, q),
        fj.inverse_kinematics: (linkage, jnp.ones(2), 0.3),
        fj.joint_positions: (linkage, q),
        fj.mass_centers: (linkage, q),
        fj.tip_jacobian: (linkage, q),
        fj.tip_position: (linkage, q),
        fj.joint_reactions: (linkage, MASSES, motion),
        fj.analysis.inertia_ratios: (linkage, q, MASSES),
        fj.analysis.equilibrium: (linkage, q, (fj.JointDamper(1.0),)),
        fj.analysis.holding_efforts: (linkage, q, MASSES),
        fj.analysis.inertial_parameters: (linkage,),
        fj.control.gains_from_frequency: (linkage, q, 5.0, 0.7, MASSES),
        fj.analysis.regressor: (linkage, q, q, q),
        fj.identification.link_ends: (scene, motion),
        fj.references.reachable: (linkage, TASK, jnp.zeros(5)),
        fj.references.reach_margin: (linkage, TASK, jnp.zeros(5)),
        fj.tuning.joint_errors: (scene, motion),
        fj.tuning.tip_errors: (scene, motion),
    }
    if n == 3:
        x = jnp.zeros(6)
        found |= {
            fj.paper.bias_force: (linkage, x, x),
            fj.paper.constraint_forces: (linkage, x, x, x),
            fj.paper.masked_accelerations: (linkage, x, x, x),
            fj.paper.mass_matrix: (linkage, x),
        }
    return found


TASK = fj.CircleTask([0.2, 0.2], 0.05)
PD = fj.PDController(1.0, 1.0, 1.0, TASK)
MASSES = (fj.forces.Armature(0.1),)
# Their arguments are names or lists of the paper's.
OTHERS = {
    fj.existence_factors: ("RFPR",),
    fj.paper.from_chain: ("RR", [0, 0, 0, 0], [0] * 4),
}


@pytest.mark.parametrize("linkage", ARMS, ids=["RPR", "PRFR"])
def test_functions_take_and_return_annotated_shapes(linkage):
    for function, arguments in calls(linkage).items():
        # Traced only, which compiles nothing.
        eqx.filter_eval_shape(checked(function), *arguments)


def test_functions_of_known_values_return_annotated_shapes():
    for function, arguments in OTHERS.items():
        checked(function)(*arguments)


def is_annotated(hint):
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return True
    return any(map(is_annotated, typing.get_args(hint)))


def test_no_public_function_is_left_out():
    tabled = {"to_pandas", "to_xarray"}  # of optional packages, without shapes
    public = {
        getattr(room, name)
        for room in NAMESPACES
        for name in set(room.__all__) - tabled
        if inspect.isfunction(getattr(room, name))
    }
    # Functions import python-control when they are called.
    hints = lambda of: typing.get_type_hints(of, localns={"control": control}).values()
    annotated = {of for of in public if any(map(is_annotated, hints(of)))}
    assert annotated == {*calls(ARMS[0]), *OTHERS}


@jaxtyped(typechecker=None)  # an axis has one size in all fields
def check_fields(value):
    for name, hint in typing.get_type_hints(type(value)).items():
        if isinstance(hint, type) and issubclass(hint, AbstractArray):
            assert isinstance(getattr(value, name), hint), (name, hint)


@pytest.mark.parametrize("linkage", ARMS, ids=["RPR", "PRFR"])
def test_fields_of_results_have_annotated_shapes(linkage):
    def found(q):
        state = fj.State(q, q)
        motion = fj.simulate(linkage, state, jnp.linspace(0, 1, 5), **SHORT)
        sampled = (linkage, state, fj.JointDamper(1.0), 0.1, 7)
        for result in (
            linkage,
            motion,
            fj.joint_efforts(linkage, MASSES, motion),
            fj.linearize(linkage, state),
            fj.simulate_sampled(*sampled, **SHORT),
        ):
            check_fields(result)
        return q

    eqx.filter_eval_shape(found, jnp.full(linkage.mass.size, 0.1))


def test_fields_of_a_tuned_scene_have_annotated_shapes(tuned):
    check_fields(tuned)
    check_fields(tuned.histories[0])
    assert checked(type(tuned).gains.fget)(tuned).shape == (2, 3)
    rates = np.zeros((4, 6), complex)
    modes = fj.analysis.Modes(rates)
    for name in ("frequency", "damping", "longest_step"):
        checked(getattr(type(modes), name).fget)(modes)
