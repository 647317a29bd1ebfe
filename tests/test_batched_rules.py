"""Second derivatives of batches, through custom rules of derivatives."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.steps.switch_derivatives import of_zero

BAR = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12])
TURNS = jnp.array([1.2, 1.0])


@pytest.mark.parametrize("axes", [(0, None), (None, 0)])
def test_a_product_with_zero_is_batched_as_both_factors(axes):
    """Whose second derivative is that of z f at z = 0."""
    both = jax.jit(jax.vmap(of_zero, axes))
    pair = [2 * TURNS if axis == 0 else jnp.array(3.0) for axis in axes]
    pair[0] *= 0
    product = lambda change: jnp.sum(both(*(x + change for x in pair)))
    assert jax.jacfwd(product)(0.0) == jax.jacrev(product)(0.0)
    assert jax.jacfwd(jax.jacfwd(product))(0.0) == 2 * len(TURNS)


class Turned(fj.Element):
    """A condition: passes 0 where a bar has turned down by an angle."""

    turn: fj.Values = fj.field((), unit="rad")

    def __call__(self, t, q, qd, linkage):
        return q[0] + self.turn


FORWARD = dict(adjoint=diffrax.ForwardMode())
MODES = {
    "hessian": (jax.hessian, {}),
    "forward twice": (lambda f: jax.jacfwd(jax.jacfwd(f)), FORWARD),
}


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
def test_ends_that_only_the_condition_moves(mode):
    """Until its end nothing differs in the members of the batch."""
    level, (second, options) = fj.State([0.0], [0.0]), MODES[mode]

    def times(turn):
        def ends(turn):
            motion = fj.simulate(BAR, level, [0, 9.0], until=Turned(turn), **options)
            return motion.end.t

        return jnp.sum(jax.vmap(ends)(turn))

    speed = lambda turn: jnp.sqrt(3 * BAR.gravity * jnp.sin(turn))
    exact = jnp.diag(jax.grad(lambda turn: jnp.sum(1 / speed(turn)))(TURNS))
    np.testing.assert_allclose(second(times)(TURNS), exact, atol=1e-10)
