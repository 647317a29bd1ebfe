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
