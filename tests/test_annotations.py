"""The shapes in annotations are those of the values."""

import inspect
import typing

import control
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import refusals
from beartype import BeartypeConf, beartype
from elements import SHORT, arm
from jaxtyping import AbstractArray, jaxtyped

import fdof_jax as fj

conf = BeartypeConf(is_pep484_tower=True)  # an int is a float
checked = jaxtyped(typechecker=beartype(conf=conf))


def is_annotated(hint):
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return True
    return any(map(is_annotated, typing.get_args(hint)))


def functions():
    """Returns the public functions with shapes in annotations, and sound arguments."""
    found = {}
    for name, (function, sound) in refusals.callables().items():
        if inspect.isfunction(function) and not name.startswith("to_"):
            # Functions import python-control when they are called.
            hints = typing.get_type_hints(function, localns={"control": control})
            if any(map(is_annotated, hints.values())):
                found[name] = function, sound
    return found


FUNCTIONS = functions()


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_take_and_return_annotated_shapes(name):
    function, sound = FUNCTIONS[name]
    if name in ("existence_factors", "from_chain"):  # of names and lists
        checked(function)(**sound)
    else:  # traced only, which compiles nothing
        eqx.filter_eval_shape(checked(function), **sound)


def test_most_functions_have_annotations():
    assert len(FUNCTIONS) > 25


@jaxtyped(typechecker=None)  # an axis has one size in all fields
def check_fields(value):
    for name, hint in typing.get_type_hints(type(value)).items():
        if isinstance(hint, type) and issubclass(hint, AbstractArray):
            assert isinstance(getattr(value, name), hint), (name, hint)


def test_fields_of_results_have_annotated_shapes(tuned):
    linkage, masses = arm("RFR"), (fj.forces.Armature(0.1),)

    def found(q):
        state = fj.State(q, q)
        motion = fj.simulate(linkage, state, jnp.linspace(0, 1, 5), **SHORT)
        sampled = linkage, state, fj.JointDamper(1.0), 0.1, 7
        check_fields(linkage)
        check_fields(motion)
        check_fields(fj.joint_efforts(linkage, masses, motion))
        check_fields(fj.linearize(linkage, state))
        check_fields(fj.simulate_sampled(*sampled, **SHORT))
        return q

    eqx.filter_eval_shape(found, jnp.full(3, 0.1))
    check_fields(tuned)
    check_fields(tuned.histories[0])
    assert checked(type(tuned).gains.fget)(tuned).shape == (2, 3)
    modes = fj.analysis.Modes(np.zeros((4, 6), complex))
    for name in ("frequency", "damping", "longest_step"):
        checked(getattr(type(modes), name).fget)(modes)
