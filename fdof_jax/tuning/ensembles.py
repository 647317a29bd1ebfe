"""Ensembles of scenes to tune: random variations of one, stacked."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from ..base.checks import instance, real_array, refusal, whole_number
from ..control.pd import ModelBased
from ..linkage.coordinates import State
from ..linkage.linkage import Linkage, check_linkage
from ..mechanics.kinematics import tip_jacobian, tip_position
from ..references.reference import reference_of
from ..simulation.scene import Scene, stacked
from .losses import controller_of, with_controller

_MOST = 1_000_000  # they are drawn one after another


def _bodies(linkage: Linkage) -> tuple[Array, Array, Array]:
    return linkage.mass, linkage.com, linkage.inertia


def with_payload(linkage: Linkage, mass: ArrayLike) -> Linkage:
    """Adds a point mass at the tip to a linkage's last link.

    **Arguments:** `mass` [kg], not negative.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.tuning.with_payload(arm, 2.0).mass.tolist()
    [1.0, 1.0, 3.0]
    """
    check_linkage(linkage)
    mass = real_array("mass", mass, (), minimum=0)
    own, center, inertia = (values[-1] for values in _bodies(linkage))
    to_tip = jnp.stack([linkage.length[-1], jnp.zeros(())]) - center
    total = own + mass
    share = mass / jnp.where(total > 0, total, 1)
    last = (
        total,
        center + share * to_tip,
        # Of two masses about their common centre: reduced mass * distance^2.
        inertia + own * share * jnp.sum(to_tip**2),
    )
    changed = [values.at[-1].set(new) for values, new in zip(_bodies(linkage), last)]
    return eqx.tree_at(_bodies, linkage, changed)


def _displaced(linkage: Linkage, q: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Joint positions with the tip moved by `offset` and the last link's angle kept."""
    aim = np.asarray(tip_position(linkage, q)) + offset
    for _ in range(50):
        missing = np.append(aim - np.asarray(tip_position(linkage, q)), 0.0)
        if np.linalg.norm(missing) < 1e-9:
            return q
        q = q + np.linalg.lstsq(np.asarray(tip_jacobian(linkage, q)), missing)[0]
    raise ValueError(
        "start_offset: expected one within the linkage's reach, got "
        f"{np.linalg.norm(offset):g} m."
    )


def perturbed(
    scene: Scene,
    members: int,
    *,
    payload: ArrayLike = (0.0, 0.0),
    link_error: ArrayLike = 0.0,
    start_offset: ArrayLike = 0.0,
    speed: ArrayLike = (1.0, 1.0),
    seed: int = 0,
) -> Scene:
    """Stacks random variations of a scene: an ensemble for robust tuning.

    All variations are drawn uniformly and independently. A model-based controller
    without a model of its own gets the nominal linkage, without the variations.

    **Arguments:**

    - `scene`: if `speed` varies, its controller's reference must have a `period`.
    - `members`: number of variations, at most a million.
    - `payload`: least and greatest point mass at the tip [kg].
    - `link_error`: greatest relative error of each mass, mass centre and inertia.
    - `start_offset`: greatest distance of the tip from its start [m], in any direction.
    - `speed`: least and greatest factor on the speed of the reference.
    - `seed`: seed of the random numbers.

    **Raises:** ValueError for malformed arguments, and for a start out of reach.

    >>> import fdof_jax as fj
    >>> ensemble = fj.tuning.perturbed(fj.scenes.fig7(), 4, payload=(0, 2))
    >>> ensemble.linkage.mass[:, 2].tolist()  # 1 kg and what it carries
    [2.715, 2.371, 1.783, 1.809]
    """
    instance("scene", scene, Scene)
    members = whole_number("members", members, 1, _MOST)
    draw = np.random.default_rng(whole_number("seed", seed, 0))
    payloads, speeds = _range("payload", payload, 0), _range("speed", speed, 1e-3)
    error = float(real_array("link_error", link_error, (), minimum=0))
    if error >= 1:
        raise ValueError(
            "link_error: expected less than 1, as masses and inertias stay positive, "
            f"got {error:g}."
        )
    reach = float(real_array("start_offset", start_offset, (), minimum=0))
    linkage, controller = scene.linkage, controller_of(scene)
    period = None
    if speeds != (1, 1):
        period = reference_of(controller.reference).period
        if period is None:
            raise refusal("speed", "(1, 1) for a reference without a `period`", speed)
    if isinstance(controller, ModelBased) and controller.model is None:
        none = lambda node: node is None
        controller = eqx.tree_at(lambda c: c.model, controller, linkage, is_leaf=none)

    def member() -> Scene:
        bodies = [
            values * (1 + draw.uniform(-error, error, values.shape))
            for values in _bodies(linkage)
        ]
        arm = eqx.tree_at(_bodies, linkage, bodies)
        arm = with_payload(arm, draw.uniform(*payloads))
        distance, angle = reach * draw.uniform(), draw.uniform(0, 2 * np.pi)
        offset = distance * np.array([np.cos(angle), np.sin(angle)])
        rate = draw.uniform(*speeds)
        q, own = np.asarray(scene.state0.q), controller
        if reach > 0:
            q = _displaced(linkage, q, offset)
        if period is not None:
            own = eqx.tree_at(lambda c: c.reference.period, own, period / rate)
        varied = scene._replace(linkage=arm, state0=State(q, scene.state0.qd))
        return with_controller(varied, own)

    return stacked([member() for _ in range(members)])


def _range(name: str, value: ArrayLike, minimum: float) -> tuple[float, float]:
    least, greatest = np.asarray(real_array(name, value, (2,), minimum=minimum))
    if least > greatest:
        raise ValueError(
            f"{name}: expected the least before the greatest, got {least:g} and "
            f"{greatest:g}."
        )
    return least, greatest
