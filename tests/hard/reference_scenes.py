"""The hard scenes of which `make_reference` computes references."""

import numpy as np

USUAL = dict(
    topology="RRR",
    length=[0.0, 1.0, 1.0, 1.0],
    com=[[0.5, 0.0]] * 3,
    mass=[1.0, 1.0, 1.0],
    inertia=[1 / 12] * 3,
    locked=[0.0, 0.0, 0.0],
    base_angle=0.0,
    gravity=9.81,
    effort=[0.0, 0.0, 0.0],
    damping=[0.0, 0.0, 0.0],
    q0=[-0.5, 0.3, 0.2],
    qd0=[0.0, 0.0, 0.0],
    t1=5.0,
)
FIG5 = dict(com=[[1.0, 0.0]] * 3, inertia=[0.0] * 3, q0=[0.0, 0.0, 0.0], t1=10.0)


def chain(topology, **changes):
    """Returns a scene of so many pairs, with the defaults of all scenes."""
    n = len(topology)
    sizes = dict.fromkeys(("inertia", "locked", "effort", "damping", "q0", "qd0"), n)
    rows = {name: [USUAL[name][0]] * size for name, size in sizes.items()}
    more = dict(length=[0.0] + [1.0] * n, com=[[0.5, 0.0]] * n, mass=[1.0] * n)
    return rows | more | dict(topology=topology) | changes


def heavy_tip(mass):
    return dict(mass=[1.0, 1.0, mass], t1=2.0)


def light_tip(mass):
    return dict(mass=[1.0, 1.0, mass], inertia=[1 / 12, 1 / 12, mass / 12], t1=2.0)


SCENES = {
    "heavy-tip-1e3": heavy_tip(1e3),
    "heavy-tip-1e6": heavy_tip(1e6),
    "light-tip-1e-6": light_tip(1e-6),
    "light-tip-1e-9": light_tip(1e-9),
    "two-links": chain("RR", q0=[-0.5, 0.3], t1=2.0),
    "double-pendulum": chain(
        "RR",
        length=[0.0, 1.0, 0.7],
        com=[[0.6, 0.1], [0.3, -0.2]],
        mass=[1.5, 0.8],
        q0=[0.4, 0.9],
        t1=10.0,
    ),
    "cart-pole": chain(
        "PR",
        length=[0.0, 0.0, 1.0],
        com=[[0.0, 0.0], [0.5, 0.0]],
        mass=[1.0, 0.3],
        # The slide is horizontal, across a ground that points down; the pole hangs.
        base_angle=-float(np.pi / 2),
        damping=[0.1, 0.02],
        q0=[0.2, 2.5],
        qd0=[0.5, 0.0],
        t1=10.0,
    ),
    "five-links": chain(
        "RRRRR",
        length=[0.0, 0.5, 0.5, 0.5, 0.5, 0.5],
        com=[[0.25, 0.05]] * 5,
        q0=[-0.5, 0.3, 0.2, -0.4, 0.6],
        damping=[0.2] * 5,
    ),
    "six-pairs": chain(
        "PRRPRR",
        length=[0.0, 0.5, 0.4, 0.3, 0.4, 0.5, 0.3],
        com=[[0.2, 0.1]] * 6,
        locked=[0.3, 0.0, 0.1, -0.5, 0.2, 0.0],
        effort=[0.0, 0.0, 0.0, 20.0, 0.0, 0.0],
        damping=[5.0, 1.0, 1.0, 20.0, 1.0, 0.5],
        q0=[0.1, -0.5, 0.3, 0.2, -0.4, 0.6],
        qd0=[0.3, 0.0, -0.5, 0.2, 0.0, 1.0],
        t1=2.0,
    ),
    "turn-slide-RPR": dict(
        topology="RPR",
        length=[0.0, 1.0, 0.0, 1.0],
        com=[[0.5, 0.0], [0.0, 0.0], [0.5, 0.0]],
        inertia=[1 / 12, 0.0, 1 / 12],
    ),
    # At rest these two would just fall.
    "parallel-axes-PPR": dict(topology="PPR", qd0=[0.2, -0.3, 0.5]),
    "parallel-axes-RPP": dict(topology="RPP"),
    "near-parallel-PPR": dict(
        topology="PPR",
        mass=[1e-6, 1.0, 1.0],
        locked=[1e-3, 0.0, 0.0],
        qd0=[0.2, -0.3, 0.5],
    ),
    "near-parallel-RPP": dict(
        topology="RPP", mass=[1.0, 1e-6, 1.0], locked=[0.0, 1e-3, 0.0]
    ),
    "driven-through-0-RPR": dict(
        topology="RPR",
        # tau = 1000 (-2 - B2') pushes the slide at 2 m/s.
        effort=[0.0, -2000.0, 0.0],
        damping=[0.0, 1000.0, 0.0],
        q0=[-0.5, 1.0, 0.2],
        qd0=[0.0, -2.0, 0.0],
        t1=1.0,
    ),
    "spin": dict(qd0=[1e3, 0.0, 0.0], t1=0.5),
    "spin-of-the-tip": dict(qd0=[0.0, 0.0, 1e3], t1=0.5),
    "fig5": FIG5,
    # `fdof_jax.scenes.two_link_circle`, whose efforts stay within their limits.
    "two-link-circle": chain(
        "RR",
        length=[0.0, 1.0, 0.8],
        com=[[0.5, 0.0], [0.4, 0.0]],
        mass=[2.0, 1.0],
        inertia=[1 / 6, 0.8**2 / 12],
        gravity=0.0,
        q0=[-0.7761207715657413, 1.8428913788142083],
        t1=4.0,
        circling=True,
    ),
}
