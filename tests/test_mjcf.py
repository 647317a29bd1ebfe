"""MuJoCo's models, written and read: both engines accelerate alike."""

import warnings
from itertools import product
from pathlib import Path

import equinox as eqx
import jax
import mujoco
import numpy as np
import pytest
from elements import Hold
from helpers import random_linkage

import fdof_jax as fj


def in_mujoco(text):
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    return model, mujoco.MjData(model)


def equal(values, expected, tolerance=1e-10):
    np.testing.assert_allclose(values, expected, rtol=tolerance, atol=tolerance)


# Written


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_accelerations_energies_and_tips_equal_mujoco(topology):
    rng = np.random.default_rng(fj.TOPOLOGIES.index(topology))
    for _ in range(20):
        linkage = random_linkage(topology, rng)
        q, qd, tau = rng.normal(size=(3, 3)) * [[1], [2], [5]]
        model, data = in_mujoco(fj.to_mjcf(linkage))
        data.qpos, data.qvel, data.qfrc_applied = q, qd, tau
        mujoco.mj_forward(model, data)
        qdd = np.asarray(fj.forward_dynamics(linkage, q, qd, tau))
        assert np.abs(qdd - data.qacc).max() <= 1e-11 * (1 + np.abs(data.qacc).max())
        equal(fj.tip_position(linkage, q), data.site("tip").xpos[:2], 1e-13)
        equal(fj.energy(linkage, q, qd)[::-1], data.energy, 1e-12)


def test_massless_tip_is_passed_as_the_smallest_that_mujoco_takes():
    linkage = fj.Linkage(
        "RRR", length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1, 1, 0],
        inertia=[0.1, 0.1, 0.1],
    )  # fmt: skip
    text = fj.to_mjcf(linkage)
    assert "tendon" not in text  # there is no spring
    model, data = in_mujoco(text)
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    assert model.opt.timestep == 1e-3
    assert model.body("link3").mass == 1e-15
    mujoco.mj_forward(model, data)
    equal(fj.forward_dynamics(linkage, *np.zeros((3, 3))), data.qacc, 1e-11)


def test_exported_elements_act_as_in_mujoco():
    """Compares accelerations of all elements that both engines model alike."""
    rng = np.random.default_rng(4)
    points = fj.Point(0, 0.3, -0.9), fj.Point(2, 0.2, 0.1)
    hold = Hold(jax.device_put(np.array([0.3, -0.2, 0.5])))
    springs = (
        fj.SpringDamper(*points, stiffness=30, damping=2, rest_length=0.4),
        fj.SpringDamper(*points, stiffness=8, rest_length=0.5, one_sided="cable"),
        fj.SpringDamper(*points, stiffness=9, rest_length=3, one_sided="bumper"),
    )
    armature = fj.forces.Armature([0.3, 0.2, 0.1])
    pd = fj.PDController([9, 7, 5], [3, 2, 1], [4, 0.5, np.inf], hold)
    forces = (fj.JointDamper([0.3, 0.2, 0.1]), armature, *springs, pd)
    for topology in ("RPR", "RRR"):
        linkage = random_linkage(topology, rng)
        model, data = in_mujoco(fj.to_mjcf(linkage, forces))
        for _ in range(5):
            q, qd = rng.normal(size=(2, 3))
            mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
            data.qpos, data.qvel = q, qd
            mujoco.mj_forward(model, data)
            tau = sum(force(0.0, q, qd, linkage) for force in forces)
            qdd = fj.forward_dynamics(linkage, q, qd, tau, (armature,))
            equal(qdd, data.qacc)
    # Stops and friction are MuJoCo's own.
    stops = fj.forces.JointStops([-1, 0, -np.inf], [1, np.inf, np.inf])
    friction = fj.forces.JointFriction([1, 2, 3])
    model, _ = in_mujoco(fj.to_mjcf(linkage, (stops, friction)))
    assert model.jnt_limited.tolist() == [1, 1, 0]
    assert model.jnt_range[0].tolist() == [-1, 1]
    assert model.dof_frictionloss.tolist() == [1, 2, 3]


@pytest.mark.slow
def test_exported_motion_equals_mujoco():
    scene = fj.scenes.fig7()
    pd = eqx.tree_at(lambda pd: pd.reference, scene.forces[0], Hold(scene.state0.q + 1))
    spring = fj.SpringDamper(
        fj.Point(0, 0.3, -0.9), fj.Point(2, 0.2), stiffness=30, rest_length=0.4
    )
    forces = (fj.JointDamper(1.0), fj.forces.Armature(0.1), spring, pd)
    scene, ts = scene._replace(forces=forces), np.linspace(0, 2, 21)
    motion = fj.simulate(scene, ts, rtol=1e-11, atol=1e-12)
    efforts = fj.joint_efforts(scene, motion).elements[3]
    assert (np.abs(efforts) >= np.asarray(pd.limit)).any()
    model, data = in_mujoco(fj.to_mjcf(scene.linkage, forces))
    model.opt.integrator, model.opt.timestep = mujoco.mjtIntegrator.mjINT_RK4, 2e-5
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos, data.qvel = scene.state0
    for expected in np.asarray(motion.q)[1:]:
        mujoco.mj_step(model, data, 5000)
        np.testing.assert_allclose(data.qpos, expected, atol=1e-6)


WET = dict(damping=1, one_sided="cable", rest_length=1)
UNWRITTEN = {
    "got JointEffort": fj.JointEffort([1, 2, 3]),
    "got function": lambda t, q, qd, linkage: q,
    "expected one JointDamper": fj.JointDamper(1.0),
    "expected no damping of a cable": fj.SpringDamper(fj.Point(0), fj.Point(1), **WET),
    "link: expected": fj.SpringDamper(fj.Point(0), fj.Point(5), stiffness=1),
}


def test_what_mujoco_does_not_have_is_refused_by_name():
    linkage = random_linkage("RRR", np.random.default_rng(0))
    for words, force in UNWRITTEN.items():
        with pytest.raises(ValueError, match=words):
            fj.to_mjcf(linkage, (fj.JointDamper(1.0), force))
    with pytest.raises(ValueError, match="linkage"):
        fj.to_mjcf(jax.tree.map(lambda a: np.stack([a, a]), linkage))
    with pytest.raises(ValueError, match="linkage: expected concrete"):
        jax.jit(fj.to_mjcf)(linkage)


# Read


CART_POLE = """<mujoco><worldbody><body name="cart" pos="0 0 1">
<joint name="slider" type="slide" axis="1 0 0" damping="0.3" armature="0.1"/>
<geom type="box" size=".2 .1 .1" mass="1"/>
<body name="pole" pos="0 0 .1"><joint name="hinge" axis="0 1 0" damping=".2"/>
<geom type="capsule" fromto="0 0 0 .1 0 .6" size=".05" mass=".5"/>
<site name="tip" pos=".1 0 .6"/></body></body></worldbody></mujoco>"""
DOUBLE = """<mujoco><option gravity="0 0 -3"/><worldbody><body euler="0 20 0">
<joint type="slide" axis="1 0 2"/><joint axis="0 -1 0" pos=".1 0 .1"/>
<geom type="capsule" fromto="0 0 0 0 0 -.5" size=".05"/>
<body pos="0 0 -.5" euler="0 30 0"><joint axis="0 -1 0" ref="20"/>
<joint type="slide" axis="1 0 .2"/>
<geom type="box" size=".3 .1 .2" pos=".1 0 -.1"/>
<body pos="0 0 -.2"><geom size=".1" mass="2"/></body>
<site name="tip" pos="0 0 -.4"/></body></body></worldbody></mujoco>"""


def with_option(option):
    return CART_POLE.replace("<mujoco>", f"<mujoco><option {option}</option>")


@pytest.mark.parametrize("text", [CART_POLE, DOUBLE])
def test_accelerations_and_tips_of_an_arm_read_equal_mujoco(text):
    model, data = in_mujoco(text)
    linkage, forces = fj.from_mjcf(text)
    rng = np.random.default_rng(0)
    tips, ours = [], []
    for _ in range(4):
        data.qpos, data.qvel = q, qd = rng.normal(size=(2, model.nq))
        mujoco.mj_forward(model, data)
        tau = sum((force(0.0, q, qd, linkage) for force in forces), np.zeros(len(q)))
        inertial = tuple(f for f in forces if isinstance(f, fj.forces.Armature))
        equal(fj.forward_dynamics(linkage, q, qd, tau, inertial), data.qacc, 1e-9)
        tips.append(data.site("tip").xpos.copy())
        ours.append(fj.tip_position(linkage, q))
    apart = [np.linalg.norm(np.diff(places, axis=0), axis=1) for places in (tips, ours)]
    np.testing.assert_allclose(*apart, atol=1e-12)


def test_arms_with_fixed_pairs_come_back_as_they_were():
    rng = np.random.default_rng(1)
    q, qd, tau = rng.normal(size=(3, 3))
    for kinds in product("RPF", repeat=3):
        if "R" not in kinds:  # a chain without a hinge is refused
            continue
        arm, moves = random_linkage("".join(kinds), rng), np.array(kinds) != "F"
        again, _ = fj.from_mjcf(fj.to_mjcf(arm))
        equal(fj.tip_position(again, q[moves]), fj.tip_position(arm, q), 1e-12)
        qdd = fj.forward_dynamics(again, q[moves], qd[moves], tau[moves])
        equal(qdd, fj.forward_dynamics(arm, q, qd, tau)[moves], 1e-9)


def test_options_of_a_model():
    assert fj.from_mjcf(with_option('gravity="0 5 -2">'))[0].gravity == 2
    assert fj.from_mjcf(with_option('><flag gravity="disable"/>'))[0].gravity == 0
    newer = "mjDSBL_DAMPER" in mujoco.mjtDisableBit.__members__
    flag = f'><flag {"damper" if newer else "passive"}="{{}}"/>'
    for state, count in (("enable", 1), ("disable", 0)):
        _, forces = fj.from_mjcf(with_option(flag.format(state)))
        assert [type(force) for force in forces].count(fj.JointDamper) == count


BODY = '<body><joint axis="0 1 0"{}/><geom size=".1"/>{}</body>'
PLAIN, WORLD = BODY.format("", ""), "<mujoco><compiler autolimits='true'/><worldbody>"
UNREAD = {
    BODY.format(' stiffness="1"', ""): "joint 0 with a spring",
    BODY.format("", PLAIN.replace("1 0", "-1 0")): "reverse it",
    9 * PLAIN[: PLAIN.index("</")] + 9 * "</body>": "9 joints",
    BODY.format(' range="-1 1"', ""): "joint 0 with a range",
    BODY.format(' frictionloss="1"', ""): "joint 0 with friction",
    '<body><freejoint name="f"/><geom size=".1"/></body>': "joint f, which is",
    PLAIN * 2: "several chains",
    BODY.format("", PLAIN * 2): "body 3 on a branch",
    BODY.format("", PLAIN.replace("0 1 0", "0 0 1")): "of joint 1",
    '<body><joint type="slide"/><geom size=".1"/></body>': "no hinge",
    f'</worldbody><option density="1"/><worldbody>{PLAIN}': "a fluid .density",
    f'</worldbody><option viscosity="1"/><worldbody>{PLAIN}': "a fluid .viscos",
    PLAIN.replace("<body", '<body gravcomp=".5"'): "body 1 with gravcomp",
    "<nothing/>": "a MuJoCo model",
}
if hasattr(mujoco.MjModel, "dof_dampingpoly"):
    UNREAD[BODY.format(' damping="1 2"', "")] = "joint 0 with nonlinear damping"
    UNREAD[BODY.format(' stiffness="0 2"', "")] = "joint 0 with a nonlinear spring"


def test_what_is_no_planar_chain_is_refused_by_name():
    for inside, words in UNREAD.items():
        with pytest.raises(ValueError, match=f"^text: expected.*{words}"):
            fj.from_mjcf(f"{WORLD}{inside}</worldbody></mujoco>")
    site, pole = '<site name="tip" pos=".1 0 .6"/>', '<body name="pole"'
    on_cart = CART_POLE.replace(site, "").replace(pole, site + pole)
    tilted = lambda axis: CART_POLE.replace('axis="1 0 0"', f'axis="{axis}"')
    for text, words in (
        (on_cart, "the site tip on .* body cart"),
        (tilted("1 4e-6 0"), "slider in the plane, got one 4e-06 rad off"),
        (tilted("1 .3 0"), "slider in the plane, got one 0.29 rad off"),
        (Path("arm.xml"), "the XML text of a model, not a .*arm.xml.*$"),
        ("arm.xml", "the XML text of a model, not a .*'arm.xml'.$"),
        ("<arm", "a MuJoCo model in XML: XML parse error .*[^\\n]$"),
    ):
        with pytest.raises(ValueError, match=f"^text: expected .*{words}"):
            fj.from_mjcf(text)


@pytest.mark.parametrize(
    "inside",
    [
        "",
        '<contact><exclude body1="a" body2="c"/></contact>',
        '<contact><pair geom1="of a" geom2="of b"/></contact>',
        '<option><flag contact="disable"/></option>',
        '<default><geom contype="0"/></default>',
        '<default><geom conaffinity="2"/></default>',
        '<default><geom contype="2" conaffinity="2"/></default>',
        '<worldbody><geom size="9"/></worldbody>',
        '<default><geom contype="0"/></default>'
        '<worldbody><geom type="plane" size="9 9 9" contype="1"/></worldbody>',
    ],
)
@pytest.mark.parametrize("welded", ["", "b"])
def test_contacts_are_left_out_with_a_warning(inside, welded):
    # All geoms overlap, so that MuJoCo reports the contacts that it lets happen.
    body = '<body name="{0}">{1}<geom name="of {0}" size="5"/>{2}</body>'
    hinge, chain = '<joint axis="0 1 0"/>', ""
    for name in "cba":
        chain = body.format(name, "" if name == welded else hinge, chain)
    text = f"<mujoco>{inside}<worldbody>{chain}</worldbody></mujoco>"
    model, data = in_mujoco(text)
    mujoco.mj_forward(model, data)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fj.from_mjcf(text)
    about = [w for w in caught if "contacts are left out" in str(w.message)]
    assert len(about) == (data.ncon > 0)
    assert all(w.filename == __file__ for w in about)


def test_the_first_link_may_collide_with_the_ground():
    ground = '<geom type="plane" size="9 9 9"/>'
    with pytest.warns(UserWarning, match="contacts are left out, but bodies world and"):
        fj.from_mjcf(f"{WORLD}{ground}{PLAIN}</worldbody></mujoco>")
