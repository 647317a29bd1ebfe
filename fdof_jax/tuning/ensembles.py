"""Ensembles: scenes that differ in numbers, stacked along a leading axis."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from ..checks import instance, real_array, whole_number
from ..control.model_based import ModelBased
from ..linkage.coordinates import State
from ..linkage.linkage import Linkage, check_linkage
from ..mechanics.kinematics import tip_jacobian, tip_position
from ..references.reference import reference_of
from ..simulation.scene import Scene, stacked
from .losses import controller_of


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
    tip = jnp.stack([linkage.length[3], jnp.zeros(())])
    own, center = linkage.mass[2], linkage.com[2]
    total = own + mass
    # The inertia of two masses about their common centre: reduced mass * distance^2.
    reduced = own * mass / jnp.where(total > 0, total, 1)
    shift = mass / jnp.where(total > 0, total, 1) * (tip - center)
    inertia = linkage.inertia[2] + reduced * jnp.sum((tip - center) ** 2)
    return eqx.tree_at(
        lambda arm: (arm.mass, arm.com, arm.inertia),
        linkage,
        (
            linkage.mass.at[2].set(total),
            linkage.com.at[2].set(center + shift),
            linkage.inertia.at[2].set(inertia),
        ),
    )


def _displaced(linkage: Linkage, q: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Joint positions with the tip moved by `offset` and the last link's angle kept."""
    aim, there = np.asarray(tip_position(linkage, q)) + offset, q
    for _ in range(50):
        missing = np.append(aim - np.asarray(tip_position(linkage, there)), 0.0)
        slopes = np.asarray(tip_jacobian(linkage, there))
        there = there + np.linalg.lstsq(slopes, missing)[0]
        if np.linalg.norm(missing) < 1e-9:
            return there
    raise ValueError(
        "start_offset: expected one within the linkage's reach, got "
        f"{np.linalg.norm(offset):g} m."
    )


def _hastened(controller: Any, rate: float) -> Any:
    """The controller with its reference faster by the factor `rate`."""
    period = controller.reference.period / rate
    return eqx.tree_at(lambda c: c.reference.period, controller, period)


def _believing(controller: Any, linkage: Linkage) -> Any:
    """The controller, with this linkage as its model if it has none."""
    if not isinstance(controller, ModelBased) or controller.model is not None:
        return controller
    return eqx.tree_at(lambda c: c.model, controller, linkage, is_leaf=_is_none)


def _is_none(node: Any) -> bool:
    return node is None


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
    - `members`: number of variations.
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
    members = whole_number("members", members, 1)
    draw = np.random.default_rng(whole_number("seed", seed, 0))
    ranges = {
        name: np.asarray(real_array(name, value, (2,), minimum=least))
        for name, value, least in (("payload", payload, 0), ("speed", speed, 1e-3))
    }
    for name, (least, greatest) in ranges.items():
        if least > greatest:
            raise ValueError(
                f"{name}: expected the least before the greatest, got {least:g} and "
                f"{greatest:g}."
            )
    error = float(real_array("link_error", link_error, (), minimum=0))
    if error >= 1:
        raise ValueError(
            "link_error: expected less than 1, as masses and inertias stay positive, "
            f"got {error:g}."
        )
    reach = float(real_array("start_offset", start_offset, (), minimum=0))
    controller = controller_of(scene)
    varied = bool((ranges["speed"] != 1).any())
    if varied and reference_of(controller.reference).period is None:
        raise ValueError(
            f"speed: expected (1, 1) for a reference without a `period`, got {speed!r}."
        )
    linkage, found = scene.linkage, []
    nominal = _believing(controller, linkage)
    forces = tuple(nominal if f is controller else f for f in scene.forces)
    scene, controller = scene._replace(forces=forces), nominal
    for _ in range(members):
        factors = [
            1 + draw.uniform(-error, error, leaf.shape)
            for leaf in (linkage.mass, linkage.com, linkage.inertia)
        ]
        arm = eqx.tree_at(
            lambda arm: (arm.mass, arm.com, arm.inertia),
            linkage,
            (linkage.mass * factors[0], linkage.com * factors[1],
             linkage.inertia * factors[2]),
        )  # fmt: skip
        arm = with_payload(arm, draw.uniform(*ranges["payload"]))
        distance, angle = reach * draw.uniform(), draw.uniform(0, 2 * np.pi)
        offset = distance * np.array([np.cos(angle), np.sin(angle)])
        rate = draw.uniform(*ranges["speed"])
        q = np.asarray(scene.state0.q)
        if reach > 0:
            q = _displaced(linkage, q, offset)
        forces = scene.forces
        if varied:
            forces = tuple(
                _hastened(force, rate) if force is controller else force
                for force in forces
            )
        found.append(Scene(arm, State(q, scene.state0.qd), forces, scene.t1))
    return stacked(found)
