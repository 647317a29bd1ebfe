"""Derivatives where several events coincide: known times, switches, and the start."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj
from fdof_jax.simulation.sensitivities import sensitivities

SLIDE = fj.Linkage(
    "P", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1], gravity=0
)
FORWARD = diffrax.ForwardMode()


class Push(fj.Element):
    """A force from a time on that it declares."""

    begin: fj.Values = fj.field((), unit="s")
    force: fj.Values = fj.field((), unit="N")

    def __call__(self, t, q, qd, linkage):
        return jnp.where(t >= self.begin, self.force, 0.0) * jnp.ones_like(q)

    @property
    def jump_ts(self):
        return jnp.reshape(self.begin, (1,))


def test_each_of_coincident_known_times_has_the_jump_of_its_element():
    """A mass of 1 kg is pushed from two times on that are both 0.5 s."""
    start, ts = fj.State(jnp.zeros(1), jnp.zeros(1)), jnp.array([0.0, 0.8])
    pushes = lambda begins: (Push(begins[0], 3.0), Push(begins[1], 5.0))
    end = lambda begins: fj.simulate(
        SLIDE, start, ts, pushes(begins), adjoint=FORWARD
    ).q[-1, 0]
    varied = lambda begins: sensitivities(
        lambda begins: fj.Scene(SLIDE, start, pushes(begins), 0.8),
        lambda scene, solution: solution.q[-1],
        begins, ts, 1e-9,
    ).jacobian[0]  # fmt: skip
    once = jnp.array([0.5, 0.5])
    for slope in (jax.jacfwd(end), varied):
        np.testing.assert_allclose(jax.jit(slope)(once), [-0.9, -1.5], atol=1e-9)


class Marks(fj.Element):
    """Forces beyond two marks on the way of a slide."""

    places: fj.Values = fj.field((2,), unit="m")

    def __call__(self, t, q, qd, linkage):
        forces = fj.forces.switch(q - self.places, jnp.array([-3.0, -5.0]), 0.0)
        return jnp.sum(forces, keepdims=True)


def both_ways(start, places):
    """Derivatives of the last position in the places by both integrations, and counts."""
    ts, state = jnp.array([0.0, 0.8]), fj.State(jnp.array([start]), jnp.array([2.0]))

    def end(places):
        found = fj.simulate(SLIDE, state, ts, (Marks(places),), adjoint=FORWARD)
        return found.q[-1, 0], found.stats

    varied = sensitivities(
        lambda places: fj.Scene(SLIDE, state, (Marks(places),), 0.8),
        lambda scene, solution: solution.q[-1],
        places, ts, 1e-9,
    )  # fmt: skip
    slope, stats = jax.jacfwd(end, has_aux=True)(places)
    return slope, varied.jacobian[0], stats["one_sided"]


def test_each_of_coincident_switches_has_its_own_jump_and_is_said_to_coincide():
    """A mass of 1 kg at 2 m/s meets both marks at 0.5 s, or starts on one of them."""
    slopes = jax.jit(both_ways)
    together = slopes(0.0, jnp.array([1.0, 1.0]))
    for slope in together[:2]:
        np.testing.assert_allclose(slope, [0.45, 0.75], atol=1e-8)
    apart = slopes(0.0, jnp.array([0.9, 1.0]))
    begun = slopes(1.0, jnp.array([1.0, 1.5]))
    assert [int(found[2]) for found in (together, apart, begun)] == [1, 0, 1]
