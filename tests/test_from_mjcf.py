"""Chains read from MuJoCo's models accelerate as there."""

import warnings
from itertools import product
from pathlib import Path

import mujoco
import numpy as np
import pytest
from helpers import random_linkage

import fdof_jax as fj

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
RANDOM = fj.to_mjcf(random_linkage("RPR", np.random.default_rng(2)))


@pytest.mark.parametrize("text", [CART_POLE, DOUBLE, RANDOM])
def test_accelerations_and_tips_equal_mujoco(text):
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    linkage, forces = fj.from_mjcf(text)
    rng = np.random.default_rng(0)
    tips, ours = [], []
    for _ in range(4):
        data.qpos, data.qvel = q, qd = rng.normal(size=(2, model.nq))
        mujoco.mj_forward(model, data)
        tau = sum((force(0.0, q, qd, linkage) for force in forces), np.zeros(len(q)))
        inertial = tuple(f for f in forces if isinstance(f, fj.forces.Armature))
        qdd = fj.forward_dynamics(linkage, q, qd, tau, inertial)
        np.testing.assert_allclose(qdd, data.qacc, rtol=1e-9, atol=1e-9)
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
        tip = fj.tip_position(again, q[moves])
        np.testing.assert_allclose(tip, fj.tip_position(arm, q), atol=1e-12)
        qdd = fj.forward_dynamics(again, q[moves], qd[moves], tau[moves])
        right = fj.forward_dynamics(arm, q, qd, tau)[moves]
        np.testing.assert_allclose(qdd, right, rtol=1e-9, atol=1e-9)


def test_a_tip_on_another_body_is_refused():
    site = '<site name="tip" pos=".1 0 .6"/>'
    pole = '<body name="pole"'
    moved = CART_POLE.replace(site, "").replace(pole, site + pole)
    with pytest.raises(
        ValueError, match="^text: expected the site tip on .* body cart"
    ):
        fj.from_mjcf(moved)


nonlinear = pytest.mark.skipif(
    not hasattr(mujoco.MjModel, "dof_dampingpoly"), reason="MuJoCo is linear there"
)
BODY = '<body><joint axis="0 1 0"{}/><geom size=".1"/>{}</body>'


@pytest.mark.parametrize(
    "inside, got",
    [
        (BODY.format(' stiffness="1"', ""), "joint 0 with a spring"),
        (BODY.format("", BODY.format("", "").replace("1 0", "-1 0")), "reverse it"),
        (9 * BODY[: BODY.index("{}</")].format("") + 9 * "</body>", "9 joints"),
        (BODY.format(' range="-1 1"', ""), "joint 0 with a range"),
        (BODY.format(' frictionloss="1"', ""), "joint 0 with friction"),
        ('<body><freejoint name="f"/><geom size=".1"/></body>', "joint f, which is"),
        (BODY.format("", "") * 2, "several chains"),
        (BODY.format("", BODY.format("", "") * 2), "body 3 on a branch"),
        (BODY.format("", BODY.format("", "").replace("0 1 0", "0 0 1")), "of joint 1"),
        ('<body><joint type="slide"/><geom size=".1"/></body>', "no hinge"),
        pytest.param(
            BODY.format(' damping="1 2"', ""),
            "joint 0 with nonlinear damping",
            marks=nonlinear,
        ),
        pytest.param(
            BODY.format(' stiffness="0 2"', ""),
            "joint 0 with a nonlinear spring",
            marks=nonlinear,
        ),
        ('</worldbody><option density="1"/><worldbody>' + BODY, "a fluid .density"),
        ('</worldbody><option viscosity="1"/><worldbody>' + BODY, "a fluid .viscos"),
        (BODY.replace("<body", '<body gravcomp=".5"'), "body 1 with gravcomp"),
        ("<nothing/>", "a MuJoCo model"),
    ],
)
def test_what_is_no_planar_chain_is_refused_by_name(inside, got):
    with pytest.raises(ValueError, match=f"^text: expected.*{got}"):
        fj.from_mjcf(
            "<mujoco><compiler autolimits='true'/><worldbody>"
            f"{inside.format('', '')}</worldbody></mujoco>"
        )


@pytest.mark.parametrize(
    "text, message",
    [
        (Path("arm.xml"), "text: expected the XML text of a model, not a .*arm.xml.*"),
        ("arm.xml", "text: expected the XML text of a model, not a .*'arm.xml'."),
        ("<arm", "text: expected a MuJoCo model in XML: XML parse error .*[^\\n]"),
    ],
)
def test_what_is_no_xml_is_refused(text, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
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
    hinge = '<joint axis="0 1 0"/>'
    chain = ""
    for name in "cba":
        chain = body.format(name, "" if name == welded else hinge, chain)
    text = f"<mujoco>{inside}<worldbody>{chain}</worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fj.from_mjcf(text)
    about = [w for w in caught if "contacts are left out" in str(w.message)]
    assert len(about) == (data.ncon > 0)
    assert all(w.filename == __file__ for w in about)


def test_gravity_across_the_plane_has_no_effect():
    text = CART_POLE.replace("<mujoco>", '<mujoco><option gravity="0 5 -2"/>')
    assert fj.from_mjcf(text)[0].gravity == 2


def test_gravity_that_a_flag_disables_is_zero():
    text = CART_POLE.replace(
        "<mujoco>", '<mujoco><option><flag gravity="disable"/></option>'
    )
    assert fj.from_mjcf(text)[0].gravity == 0


def test_dampers_that_a_flag_disables_are_left_out():
    kinds = mujoco.mjtDisableBit.__members__
    flag = "damper" if "mjDSBL_DAMPER" in kinds else "passive"
    text = CART_POLE.replace(
        "<mujoco>", f'<mujoco><option><flag {flag}="{{}}"/></option>'
    )
    kinds = [
        [type(force).__name__ for force in fj.from_mjcf(text.format(state))[1]]
        for state in ("enable", "disable")
    ]
    assert "JointDamper" in kinds[0] and "JointDamper" not in kinds[1]


@pytest.mark.parametrize("axis, off", [("1 4e-6 0", "4e-06"), ("1 .3 0", "0.29")])
def test_a_slide_out_of_the_plane_says_by_how_much(axis, off):
    tilted = CART_POLE.replace('axis="1 0 0"', f'axis="{axis}"')
    with pytest.raises(ValueError, match=f"slider in the plane, got one {off} rad off"):
        fj.from_mjcf(tilted)
