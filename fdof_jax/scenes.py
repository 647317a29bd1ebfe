"""The paper's three examples as data; each value is from the figure's own list."""

import numpy as np

from .control.pd import PDController
from .forces.joints import JointDamper
from .linkage.coordinates import State, from_chain
from .linkage.linkage import Linkage
from .references.circle import CircleTask
from .simulation.scene import Scene as Scene


def fig3() -> Scene:
    """Figs 3 and 4: a damped triple pendulum with offset mass centres, from rest.

    Gravity is not printed; we choose 9.81 m/s^2. The damping acts on the relative rates
    of the revolute joints.

    >>> import fdof_jax as fj
    >>> scene = fj.scenes.fig3()
    >>> scene.t1, scene.linkage.mass.tolist(), scene.forces[0].coefficient.tolist()
    (20.0, [5.0, 2.0, 1.0], [20.0, 20.0, 20.0])
    """
    linkage = Linkage(
        "RRR",
        length=[0, 1, 1, 1],
        com=[[0.5, -1], [0.5, 1], [1, -1]],
        mass=[5, 2, 1],
        inertia=[0, 0, 0],
    )
    state0 = State(np.zeros(3), np.zeros(3))
    return Scene(linkage, state0, (JointDamper(20.0),), 20.0)


def fig5() -> Scene:
    """Figs 5 and 6: a conservative triple pendulum of point masses, from rest.

    Gravity is not printed; we choose 9.81 m/s^2.

    >>> import fdof_jax as fj
    >>> arm, start, forces, t1 = fj.scenes.fig5()
    >>> sum(map(float, fj.energy(arm, *start))), forces  # conservative, from rest
    (0.0, ())
    """
    linkage = Linkage(
        "RRR",
        length=[0, 1, 1, 1],
        com=[[1, 0], [1, 0], [1, 0]],
        mass=[1, 1, 1],
        inertia=[0, 0, 0],
    )
    return Scene(linkage, State(np.zeros(3), np.zeros(3)), (), 10.0)


def fig7() -> Scene:
    """Fig 7: an RPR arm under saturated PD control whose tip tracks a circle.

    The initial angles are absolute, and the list's second "THETA 4" is theta 1. Gravity
    and the circle are not printed: we choose 9.81 m/s^2 and the default `CircleTask`.

    >>> import fdof_jax as fj
    >>> arm, start, (control,), t1 = fj.scenes.fig7()
    >>> control(0.0, *start, arm).tolist()  # the slide's force is at its limit
    [15.873, -300.0, -9.921]
    """
    locked, state0 = from_chain(
        "RPR", [0, np.pi / 2, 2.5, np.pi, 0, np.pi / 2], np.zeros(6)
    )
    linkage = Linkage(
        "RPR",
        length=[0, 1, 2.5, 1],
        com=[[1, 0], [2.5, 0], [1, 0]],
        mass=[1, 1, 1],
        inertia=[1, 1, 1],
        locked=locked,
    )
    controller = PDController(
        kp=[1500, 20000, 800],
        kd=[80, 50, 50],
        limit=[1000, 300, 400],
        reference=CircleTask(),
    )
    return Scene(linkage, state0, (controller,), 10.0)
