"""The modes of differentiation that tests ask for by name."""

import diffrax

# By default `jax.grad` in a few numbers takes tangents. With a checkpoint at each step
# no part of a motion is repeated with other rounding, which could accept other steps.
ADJOINT = diffrax.RecursiveCheckpointAdjoint(checkpoints=1024)
