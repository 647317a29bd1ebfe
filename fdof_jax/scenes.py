"""Examples as data: the paper's three, each value from its figure, and others."""

import numpy as np

from . import (
    TOPOLOGIES,
    CircleTask,
    JointDamper,
    Linkage,
    PDController,
    Scene as Scene,
    State,
    TipTask,
    inverse_kinematics,
)
from .paper import from_chain
from .references import Ellipse, Laps

# Of `circle_scenes`, the common start in chain coordinates B1, th2, B2, th3, B3, th4.
# From here every topology follows the circle away from its singularities.
_START = np.array([0.0, 1.0, -0.1, -1.0, 0.7, 0.8])
_BASE = np.pi / 2  # a slide on the ground is level
# The assembly (of two) that each arm starts in.
_BRANCH = dict(zip(TOPOLOGIES, (-1, 1, -1, -1, 1, 1, 1)))
_KP, _KD = {"R": 500.0, "P": 2000.0}, {"R": 50.0, "P": 200.0}


def fig3() -> Scene:
    """Figs 3 and 4: a damped triple pendulum with offset mass centres, from rest.

    Gravity is not printed; we choose 9.81 m/s^2. The damping acts on the relative rates
    of the revolute joints.

    >>> import fdof_jax as fj
    >>> scene = fj.scenes.fig3()
    >>> scene.t1, scene.linkage.mass.tolist(), float(scene.forces[0].coefficient)
    (20.0, [5.0, 2.0, 1.0], 20.0)
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


def double_pendulum() -> Scene:
    """A conservative double pendulum of two rods of 1 kg and 1 m, released raised.

    It starts 0.5 [rad] above the horizontal and moves in a vertical plane for 10 s.

    >>> import fdof_jax as fj
    >>> fj.scenes.double_pendulum().linkage.mass.tolist()  # [kg]
    [1.0, 1.0]
    """
    linkage = Linkage(
        "RR",
        length=[0, 1, 1],
        com=[[0.5, 0], [0.5, 0]],
        mass=[1, 1],
        inertia=[1 / 12, 1 / 12],
    )
    return Scene(linkage, State([0.5, 0.5], [0, 0]), (), 10.0)


def cart_pole() -> Scene:
    """A pole that hangs from a cart on a horizontal rail, 0.2 rad from equilibrium.

    The ground's frame points down: the cart slides along x [m], and the pole hangs at
    an angle of 0 [rad].

    >>> import fdof_jax as fj
    >>> arm, start, *_ = fj.scenes.cart_pole()
    >>> fj.tip_position(arm, [0.3, 0.0]).tolist()  # below the cart
    [0.3, -1.0]
    """
    linkage = Linkage(
        "PR",
        length=[0, 0, 1],
        com=[[0, 0], [0.5, 0]],
        mass=[1, 0.3],
        inertia=[0, 0.025],
        base_angle=-np.pi / 2,
    )
    return Scene(linkage, State([0.0, 0.2], [0, 0]), (), 10.0)


def two_link_circle() -> Scene:
    """A two-link arm in a horizontal plane, whose tip tracks a circle by PD control.

    The circle has a radius of 0.3 [m] and a period of 2 [s]; the tip starts 0.1 m off.

    >>> import fdof_jax as fj
    >>> arm, start, (control,), t1 = fj.scenes.two_link_circle()
    >>> fj.tip_position(arm, start.q).tolist()  # 0.1 m beside the circle's start
    [1.1, 0.0]
    """
    linkage = Linkage(
        "RR",
        length=[0, 1, 0.8],
        com=[[0.5, 0], [0.4, 0]],
        mass=[2, 1],
        inertia=[1 / 6, 0.8**2 / 12],
        gravity=0,
    )
    circle = Ellipse([0.7, 0], [0.3, 0.3])
    task = TipTask(circle, Laps(period=2.0), orientation=None)
    controller = PDController(kp=100, kd=10, limit=[60, 30], reference=task)
    start = inverse_kinematics(linkage, [1.1, 0], None)
    return Scene(linkage, State(start, np.zeros(2)), (controller,), 4.0)


def five_links() -> Scene:
    """A conservative chain of five rods of 1 kg and 0.5 [m], bent and at rest.

    >>> import fdof_jax as fj
    >>> fj.scenes.five_links().linkage.mass.shape
    (5,)
    """
    linkage = Linkage(
        "RRRRR",
        length=[0, *[0.5] * 5],
        com=[[0.25, 0]] * 5,
        mass=[1] * 5,
        inertia=[0.25 / 12] * 5,
    )
    return Scene(linkage, State([-0.5, 0.3, 0.2, -0.4, 0.6], np.zeros(5)), (), 10.0)


def circle_scenes() -> dict[str, Scene]:
    """The same circle for an arm of each topology, under PD control and gravity.

    Only the real joint of each pair differs. All arms have links of 1 m, 0.8 m and 0.5
    m with masses of 2 kg, 1.5 kg and 1 kg. They start at rest in the same
    configuration, with the tip 5 cm inside the circle of 0.25 m radius, and keep the
    angle of the last link. Joints of a kind have the same gains and limits (150 N m or
    N).

    >>> import fdof_jax as fj
    >>> scenes = fj.scenes.circle_scenes()
    >>> starts = [fj.tip_position(s.linkage, s.state0.q) for s in scenes.values()]
    >>> starts[0].tolist(), starts[-1].tolist()  # the same for all
    ([1.994, 1.151], [1.994, 1.151])
    """
    scenes = {}
    for topology in TOPOLOGIES:
        locked, state0 = from_chain(topology, _START, np.zeros(6), base_angle=_BASE)
        linkage = Linkage(
            topology,
            length=[0.3, 1.0, 0.8, 0.5],
            com=[[0.5, 0], [0.4, 0], [0.25, 0]],
            mass=[2, 1.5, 1],
            inertia=[0.2, 0.1, 0.05],
            locked=locked,
            base_angle=_BASE,
        )
        task = CircleTask(
            center=[1.99, 0.95],
            radius=0.25,
            period=4.0,
            phase=np.pi / 2,
            orientation=_START[5],
            branch=_BRANCH[topology],
        )
        kp, kd = ([of[kind] for kind in topology] for of in (_KP, _KD))
        controller = PDController(kp, kd, 150.0, task)
        scenes[topology] = Scene(linkage, state0, (controller,), 4.0)
    return scenes
