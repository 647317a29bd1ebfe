"""Several joints that are held for a while: roundings, and laws of random scenes.

All of these arms have five joints, by one program.
"""

import held_scenes as held
import jax.numpy as jnp
import numpy as np
import pytest
from held_scenes import LATER, NEVER, Held

import fdof_jax as fj
from fdof_jax.forces import Brake, HardStops, JointFriction, Payload

pytestmark = pytest.mark.slow
inf, G = np.inf, 9.81


def whole(row, rest=0.0):
    return np.append(np.asarray(row, float), np.full(5 - len(row), rest))


def several(
    topology, q, qd, *, load=0.0, level=0.0, static=None, stops=(-inf, inf),
    restitution=0.0, brake=(1, NEVER, LATER), carried=0.0, taken=NEVER, **links,
):  # fmt: skip
    """Returns a scene; fixed pairs without mass complete the arm."""
    n = len(topology)
    static = level if static is None else static
    of_links = dict(length=[0] + [1] * n, com=[[0.5, 0]] * n, mass=[1] * n)
    links = of_links | dict(inertia=[1 / 12] * n, locked=[0] * n, gravity=0.0) | links
    com = np.concatenate([links["com"], np.zeros((5 - n, 2))])
    links |= {k: whole(links[k]) for k in ("mass", "inertia", "locked")}
    links |= dict(com=com, length=np.append(links["length"], np.zeros(5 - n)))
    each = lambda x, rest=0.0: whole(np.broadcast_to(np.asarray(x, float), n), rest)
    forces = (
        # Of a load, so soft and so far from its rest that its effort is constant.
        fj.forces.JointSpring(whole([1e-6 * bool(load)]), rest=1e6 * load),
        JointFriction(each(level), static=each(static)),
        HardStops(
            each(stops[0], -inf), each(stops[1], inf), restitution=each(restitution)
        ),
        Brake(*brake),
        Payload(fj.Point(n), carried, 0.0, begin=taken, velocity=[0.0, 0.0]),
    )
    arm = fj.Linkage(topology + "F" * (5 - n), **links)
    return Held(arm, fj.State(jnp.asarray(whole(q)), jnp.asarray(whole(qd))), forces)


def run(scene, ts):
    return fj.simulate(scene.linkage, scene.state0, ts, scene.forces)


def test_a_brake_holds_to_the_last_bit():
    """The compensated sum carries rounding errors of the steps before."""
    for begin in np.linspace(0.25, 0.75, 11):
        scene = several("RR", [0.3, 0.8], [1.0, 2.0], brake=(2, begin, LATER))
        motion = run(scene, np.linspace(0, 1, 41))
        # In NumPy, as in JAX each number of rows is another program.
        ts, q, qd = map(np.asarray, (motion.ts, motion.q, motion.qd))
        np.testing.assert_array_equal(qd[ts > begin, 1], 0)
        assert np.ptp(q[ts > begin, 1]) == 0


def test_a_fixed_pair_has_no_stops():
    """Its position is 0, which need not lie within a range that others have."""
    options = dict(stops=([0.5, 0.5], [1.0, 1.0]), restitution=0.5, gravity=G)
    motion = run(several("RF", [0.7, 0.0], [0.0, 0.0], **options), [0, 1.0])
    assert 0.5 <= motion.q[-1, 0] <= 0.7


def test_a_rounding_error_frees_no_joint():
    """Inertia couples two slides by 6e-17, as pi / 2 is rounded; one rests on load."""

    def crossed(angle=np.pi / 2, rate=0.0, stop=inf, load=1.5, **options):
        return several(
            "PP", [0.0, 0.0], [rate, 1.0], load=load, level=[1.0, 0.0],
            static=[2.0, 0.0], stops=(-inf, [inf, stop]), restitution=0.5,
            length=[0, 0, 0], com=[[0, 0]] * 2, inertia=[1, 1], locked=[angle, 0],
            taken=1.0, **options,
        )  # fmt: skip

    scene = crossed()
    assert 0 < fj.mass_matrix(scene.linkage, np.zeros(5))[0, 1] < 1e-15
    brake = dict(brake=(2, 0.7, LATER))
    for case in (
        brake, dict(carried=1e-9), dict(carried=0.5), dict(stop=0.5), dict(rate=1e-17),
        dict(rate=-1e-14),
    ):  # fmt: skip
        motion = run(crossed(**case), [0, 2.0])
        assert motion.q[-1, 0] == 0 and motion.qd[-1, 0] == 0, case
        assert (motion.modes[:, 0] == 1).all(), case
        assert motion.events.count == sum(k in case for k in ("brake", "stop")), case
    # What is no rounding error frees it: a rate, a load, a blow of slides that are not
    # quite perpendicular.
    for case, end in (
        (dict(rate=1e-9), 2e-9 + 0.5), (dict(load=2.1), 1.1),
        (dict(angle=np.pi / 2 - 1e-6) | brake, 0.125 * 1.3**2),
    ):  # fmt: skip
        motion = run(crossed(**case), [0, 2.0])
        np.testing.assert_allclose(motion.q[-1, 0], end, rtol=1e-5)


# Three of five joints throw each other at their stops a hundred times within 1e-3 s.
CASCADE = dict(
    q=[0.4127555772777217, 0.10663577576717986, 0.2294965609839984,
       0.04362499146542287, 0.4350724237877682],
    qd=[-0.1019495193972042, -1.9037264540263323, 2.829787525711607,
        2.38619061070529, 2.7639893155816297],
    stops=([-1.3650253838294104, -0.8621346523419489, -0.8407652751647515,
            -0.6445447869409455, -0.8397591843599618],
           [1.1158174343103087, 1.3086982603139599, 0.6632268532491,
            0.8873668421341108, 0.9412615544639757]),
    restitution=[0.49971664577198616, 0.7169891762068814, 0.2931325634466204,
                 0.2772967188843861, 0.20989561789762632],
)  # fmt: skip


def test_a_cascade_of_blows_is_no_chatter():
    links = dict(length=[0] + [0.4] * 5, com=[[0.2, 0.02]] * 5, inertia=[0.02] * 5)
    scene = several("RRRRR", **CASCADE, gravity=G, **links)
    motion = run(scene, [0, 4.0])
    energy = [sum(fj.energy(scene.linkage, motion.q[k], motion.qd[k])) for k in (0, 1)]
    np.testing.assert_allclose(energy[0] - energy[1], motion.taken[1], atol=1e-8)
    assert motion.events.count > 20


# One of two slides is held, which are parallel.
PARALLEL = several(
    "RPP", [0.3, -0.2, 0.1], [1.0, 0.5, 0.0], brake=(2, 0.1, LATER), gravity=G,
    length=[0, 0.3, 1.2, 0.6], com=[[0, 0.5], [0.2, 0.1], [0.4, -0.3]],
    mass=[2.3, 1.4, 0.7], inertia=[0.3, 0.5, 0.1], locked=[0.3, -0.4, 0.5],
    base_angle=1.3,
)  # fmt: skip


@pytest.mark.parametrize("seed", [None, 2, 3, 18, 26, 33])  # of five joints
def test_laws_of_random_scenes(seed):
    """The books of energy close, held joints stand still, efforts stay in bounds."""
    rng = np.random.default_rng(seed)
    errors = held.law_errors(PARALLEL if seed is None else held.random_scene(rng))
    assert max(errors.values()) <= 1, errors
