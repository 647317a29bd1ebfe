"""The modes of differentiation that tests ask for by name."""

import diffrax

# By default `jax.grad` in a few numbers takes tangents.
ADJOINT = diffrax.RecursiveCheckpointAdjoint(checkpoints=64)
