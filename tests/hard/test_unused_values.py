"""Scene 27: junk in values that a topology does not use, as 0 x NaN is NaN."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj
from hard.scenes import OUTPUTS, START, arm, behind_the_door

TS = np.linspace(0, 0.5, OUTPUTS)
JUNK = [1e30, np.nan]


def unused(topology):
    """Returns the entries of a linkage that no acceleration depends on."""
    entries = {"length": [0, 3], "locked": [], "com": [], "inertia": []}
    if topology.startswith("R"):
        entries["locked"].append(0)  # where it stands, not how it moves
    # Links that only slide do not turn.
    for link, joint in enumerate(topology):
        if joint == "R":
            break
        entries["com"].append(link)
        entries["inertia"].append(link)
    return {name: rows for name, rows in entries.items() if rows}


def fictitious(topology):
    """Returns which of the six chain coordinates belong to no joint."""
    return np.flatnonzero(np.asarray(fj.existence_factors(topology)) == 0)


def with_junk(array, rows, junk):
    for row in rows:
        array = array.at[row].set(junk)
    return array


@jax.jit
def masked(linkage, x, xd, force):
    """Returns accelerations of the paper's form, and their derivatives."""

    def accelerations(mass, x):
        changed = eqx.tree_at(lambda a: a.mass, linkage, mass)
        return fj.paper.masked_accelerations(changed, x, xd, force)

    arguments = linkage.mass, x
    return accelerations(*arguments), jax.jacrev(accelerations, (0, 1))(*arguments)


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_efforts_of_fictitious_joints(topology):
    """The paper's equations add them and subtract them again."""
    linkage = arm(topology, locked=0.2)
    x, xd = fj.paper.to_chain(linkage, START.q, START.qd)
    force = jnp.arange(1.0, 7.0)
    clean = masked(linkage, x, xd, with_junk(force, fictitious(topology), 0.0))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(clean))
    for junk in JUNK:
        dirty = with_junk(force, fictitious(topology), junk)
        for a, b in zip(*map(jax.tree.leaves, (masked(linkage, x, xd, dirty), clean))):
            np.testing.assert_array_equal(a, b, err_msg=str(junk))
    with pytest.raises(ValueError, match="^force: expected .*finite"):
        fj.paper.masked_accelerations(linkage, x, xd, dirty)


def motion(linkage):
    """A motion and its gradient, where no door sees the values."""
    solution, _, slopes = behind_the_door(linkage, START.q, TS)
    return (solution.q, slopes), solution


@pytest.mark.parametrize("junk", JUNK)
@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_parameters_that_a_topology_does_not_use(topology, junk):
    """One compiled program serves all topologies and selects unused values away.

    Selections multiply by 0 in reverse mode. NaN in arguments raises an error
    (tests/refusals.py). If it is traced, it spoils links that only slide, and
    the motion reports it.
    """
    linkage = arm(topology, locked=[0.2, 0.3, 0.4])
    clean, solution = motion(linkage)
    assert solution.outcome == "successful"
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(clean))
    for name, rows in unused(topology).items():
        spoilt = with_junk(getattr(linkage, name), rows, junk)
        dirty, solution = motion(
            eqx.tree_at(lambda a, name=name: getattr(a, name), linkage, spoilt)
        )
        if np.isnan(junk) and name in ("com", "inertia"):
            assert solution.outcome == "not finite"
            continue
        for a, b in zip(*map(jax.tree.leaves, (dirty, clean))):
            np.testing.assert_array_equal(a, b, err_msg=name)
