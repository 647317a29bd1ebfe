"""Gains from natural frequencies and damping ratios."""

from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..base.checks import real_array
from ..dynamics import mass_matrix
from ..forces.element import Forces
from ..linkage.linkage import Linkage, joints_of, without_fixed


def gains_from_frequency(
    linkage: Linkage,
    q: ArrayLike,
    frequency: ArrayLike,
    damping_ratio: ArrayLike,
    forces: Forces = (),
) -> tuple[Float[Array, " joint"], Float[Array, " joint"]]:
    """Computes the gains of PD control for given natural frequencies and damping.

    The gains are kp = frequency^2 M_kk and kd = 2 damping_ratio frequency M_kk, with
    the inertia M_kk that joint k moves at `q` while the other joints stand still. A
    joint then has exactly this frequency and damping if it moves alone, without gravity
    and without springs or dampers. `closed_loop_modes` shows the modes of all joints
    together, under all forces. The gains of `ComputedTorque` are frequency^2 and
    2 damping_ratio frequency themselves.

    **Arguments:**

    - `linkage`, `q`: the arm and its joint positions [m or rad].
    - `frequency`: natural frequencies, one per joint or one for all, positive [rad/s].
    - `damping_ratio`: one per joint or one for all, not negative.
    - `forces`: elements, of which those with masses count.

    **Returns:** `kp` [N/m or N m/rad] and `kd` [N s/m or N m s/rad], 0 at fixed pairs.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> kp, kd = fj.control.gains_from_frequency(
    ...     arm, [0, 0, 0], frequency=[5, 5, 10], damping_ratio=0.7)
    >>> kp.tolist(), kd.tolist()  # of 14, 5 and 1 kg m^2
    ([350.0, 125.0, 100.0], [98.0, 35.0, 14.0])
    """
    inertia = mass_matrix(linkage, q, forces).diagonal()
    n = joints_of(linkage)
    frequency = real_array(
        "frequency", frequency, (n,), above=0, broadcast=True, unit="rad/s",
        of=f"{n} joints",
    )  # fmt: skip
    damping_ratio = real_array(
        "damping_ratio", damping_ratio, (n,), minimum=0, broadcast=True,
        of=f"{n} joints",
    )  # fmt: skip
    kp, kd = frequency**2 * inertia, 2 * damping_ratio * frequency * inertia
    return without_fixed(linkage, kp), without_fixed(linkage, kd)
