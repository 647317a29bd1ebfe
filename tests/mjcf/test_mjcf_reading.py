"""Models of others: read, refused by name, and moving as in MuJoCo."""

import warnings

import equinox as eqx
import mjcf_oracle
import mujoco
import numpy as np
import pytest
from mjcf_oracle import equal, in_mujoco
from mjcf_random import random_text
from mjcf_texts import REFUSED, TEXTS, box_stl

import fdof_jax as fj

NEVER = "ignore:source. contacts are left out"
REDUNDANT = "ignore:revolute joints . and . coincide"


def check(text, folder, states):
    source, model = text.source(folder), text.model(folder)
    read = lambda controls: fj.from_mjcf(source, controls=controls, **text.options)
    drop, rng = text.options.get("drop", ()), np.random.default_rng(0)
    error = mjcf_oracle.compare(model, read, rng, states, drop)
    assert error <= text.tolerance, text.name
    return model, read, drop


# Of each style one; slow tests have them all.
SHORT = {
    "rail cart-pole", "reacher with a target", "opposite elbow with everything",
    "limited joints", "integrated velocities", "dc motors with currents", "pid",
    "slack spring", "included pole", "urdf cart-pole", "hinge before its slides",
}  # fmt: skip


@pytest.mark.filterwarnings(NEVER)
@pytest.mark.parametrize("text", TEXTS, ids=lambda text: text.name)
def test_models_are_read(text, tmp_path):
    arm, start, forces, account = fj.from_mjcf(text.source(tmp_path), **text.options)
    assert len(arm.mass) == text.joints == len(start.q)
    assert str(account).count("joint ") >= text.joints
    if text.name in SHORT:
        check(text, tmp_path, states=4)


def test_a_mass_off_by_a_part_in_a_thousand_is_seen():
    text = next(text.text for text in TEXTS if text.name == "vertical xz")
    model = mujoco.MjModel.from_xml_string(text)
    model.body_mass[2] *= 1.001
    read = lambda controls: fj.from_mjcf(text)
    assert mjcf_oracle.compare(model, read, np.random.default_rng(0), 4) > 1e-5


@pytest.mark.slow
@pytest.mark.filterwarnings(NEVER)
@pytest.mark.parametrize("text", TEXTS, ids=lambda text: text.name)
def test_models_accelerate_and_move_as_in_mujoco(text, tmp_path):
    model, read, drop = check(text, tmp_path, states=20)
    # Accelerations and starts tell all of a motion but actuators with a state.
    if "stateful" in text.features:
        assert mjcf_oracle.compare_motion(model, read, drop=drop) < 1e-5


@pytest.mark.slow
@pytest.mark.filterwarnings(NEVER)
def test_random_models_accelerate_as_in_mujoco():
    rng = np.random.default_rng(0)
    for _ in range(30):
        text, features = random_text(rng)
        model = mujoco.MjModel.from_xml_string(text)
        read = lambda controls, text=text: fj.from_mjcf(text, controls=controls)
        assert mjcf_oracle.compare(model, read, rng, states=4) < 1e-11, features


def test_models_and_specifications_are_sources_and_stay_as_they_are(tmp_path):
    text = next(text for text in TEXTS if text.name == "opposite elbow with everything")
    file = tmp_path / "arm.xml"
    file.write_text(text.text)
    model = mujoco.MjModel.from_xml_string(text.text)
    before = model.opt.gravity.copy(), model.dof_damping.copy()
    first = fj.from_mjcf(text.text)
    spec = mujoco.MjSpec.from_string(text.text)
    for source in (model, spec, str(file), file):
        other = fj.from_mjcf(source)
        assert eqx.tree_equal(tuple(first[:3]), tuple(other[:3]))
    equal(model.opt.gravity, before[0])
    equal(model.dof_damping, before[1])


def test_numbers_of_the_account_and_of_the_elements():
    """Of an arm whose second hinge turns against the first."""
    arm = fj.from_mjcf(
        """<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body>
        <joint name="a" axis="0 1 0" frictionloss=".3"/><geom size=".1" pos=".5 0 0"/>
        <body pos="1 0 0"><joint name="b" axis="0 -1 0" range="-1 .5" margin=".1"
        stiffness="4" springref=".2" armature=".1"/><geom type="capsule" fromto="0 0 0
        .7 0 0"
        size=".01" contype="0"/></body></body></worldbody>
        <actuator><position joint="b" kp="9" kv="2" gear="3" forcerange="-4 4"/>
        </actuator><keyframe><key qpos=".1 .2" qvel=".3 .4" ctrl=".6"/></keyframe>
        </mujoco>"""
    )
    armature, spring, friction, stops, pd = arm.forces
    equal(arm.state0, [[0.1, -0.2], [0.3, -0.4]])
    equal(armature.inertia, [0, 0.1])
    equal((spring.stiffness, spring.rest), [[0, 4], [0, -0.2]])
    equal(friction.level, [0.3, 0])
    equal((stops.lower, stops.upper), [[-np.inf, -0.4], [np.inf, 0.9]])
    equal((pd.kp, pd.kd, pd.limit), [[0, 81], [0, 18], [np.inf, 12]])
    equal(pd.reference.q, [0, -0.2])
    equal(fj.tip_position(arm.linkage, [0, 0]), [-1.7, 0])
    words = str(arm.account)
    for part in (
        "q = -qpos",
        "range -0.4 to 0.9",
        "JointFriction, which holds still",
        "0.6",
    ):
        assert part in words, words


def test_a_robot_keeps_its_meshes_apart_and_has_named_links(tmp_path):
    """Meshes of one name in two folders; a fixed link is the tip."""
    for folder, size in (("one", 0.1), ("two", 0.2)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "part.stl").write_bytes(box_stl(size, size, size))
    mesh = '<collision><geometry><mesh filename="{}/part.stl"/></geometry></collision>'
    link = '<link name="{}">{}</link>'
    joint = '<joint name="{0}{1}" type="{2}"><parent link="{0}"/><child link="{1}"/>'
    origin = '<origin xyz="{} 0 0"/><axis xyz="0 1 0"/></joint>'
    file = tmp_path / "arm.urdf"
    file.write_text(
        "<!-- a robot --><robot name='r'>"
        + link.format("base", "")
        + link.format("a", mesh.format("one"))
        + link.format("b", mesh.format("two"))
        + link.format("flange", "")
        + (joint + origin.format(0)).format("base", "a", "continuous")
        + (joint + origin.format(0.5)).format("a", "b", "continuous")
        + (joint + origin.format(0.3)).format("b", "flange", "fixed")
        + "</robot>"
    )
    arm = fj.from_mjcf(file, tip="flange", drop=("contacts",)).linkage
    # Boxes of 1000 kg/m^3. MuJoCo 3 mixes up the meshes, so that it is no reference.
    equal(arm.mass, [1, 8], 1e-6)
    equal(np.hypot(*fj.tip_position(arm, [0, 0])), 0.8)


@pytest.mark.slow
def test_a_stop_is_about_as_stiff_as_in_mujoco():
    text = """<mujoco><compiler autolimits="true"/><option gravity="0 0 0"/><worldbody>
    <body><joint name="s" type="slide" axis="1 0 0" range="-1 1"
    solreflimit=".05 1"/><geom size=".1" mass="2"/></body></worldbody>
    <actuator><motor joint="s"/></actuator></mujoco>"""
    model, data = in_mujoco(text)
    arm = fj.from_mjcf(text, controls=[40])
    data.ctrl[:], data.qpos[:] = 40, 1
    for _ in range(2000):
        mujoco.mj_step(model, data)
    ours = fj.simulate(arm.linkage, fj.State([1.0], [0.0]), [0, 20.0], arm.forces)
    np.testing.assert_allclose(ours.q[-1] - 1, data.qpos - 1, rtol=0.2)


CART_POLE = """<mujoco><worldbody><body name="cart" pos="0 0 1">
<joint name="slider" type="slide" axis="1 0 0" damping="0.3" armature="0.1"/>
<geom type="box" size=".2 .1 .1" mass="1"/>
<body name="pole" pos="0 0 .1"><joint name="hinge" axis="0 1 0" damping=".2"/>
<geom type="capsule" fromto="0 0 0 .1 0 .6" size=".05" mass=".5"/>
<site name="tip" pos=".1 0 .6"/></body></body></worldbody></mujoco>"""


def with_option(option):
    return CART_POLE.replace("<mujoco>", f"<mujoco><option {option}</option>")


def test_options_of_a_model():
    assert fj.from_mjcf(with_option('gravity="0 5 -2">')).linkage.gravity == 2
    assert fj.from_mjcf(with_option('><flag gravity="disable"/>')).linkage.gravity == 0
    newer = "mjDSBL_DAMPER" in mujoco.mjtDisableBit.__members__
    flag = f'><flag {"damper" if newer else "passive"}="{{}}"/>'
    for state, count in (("enable", 1), ("disable", 0)):
        forces = fj.from_mjcf(with_option(flag.format(state))).forces
        assert [type(force) for force in forces].count(fj.JointDamper) == count


BODY = '<body><joint axis="0 1 0"{}/><geom size=".1"/>{}</body>'
PLAIN, WORLD = BODY.format("", ""), "<mujoco><compiler autolimits='true'/><worldbody>"
UNREAD = {
    '<geom size=".1"/>': "without joints",
    PLAIN.replace("<body", '<body gravcomp=".5"'): "body 1 with compensated gravity",
    "<nothing/>": "a model that MuJoCo accepts",
}
if hasattr(mujoco.MjModel, "dof_dampingpoly"):
    UNREAD[BODY.format(' damping="1 2"', "")] = "joint 0 with nonlinear damping"
    UNREAD[BODY.format(' stiffness="0 2"', "")] = "joint 0 with a nonlinear spring"


def test_what_is_no_planar_chain_is_refused_by_name(tmp_path):
    for inside, words in UNREAD.items():
        with pytest.raises(ValueError, match=f"^source: expected.*{words}"):
            fj.from_mjcf(f"{WORLD}{inside}</worldbody></mujoco>")
    for words, text in REFUSED.values():
        with pytest.raises(ValueError, match=f"^source: expected .*({words})"):
            fj.from_mjcf(text)
    (tmp_path / "empty.xml").write_text("")
    for source, words in (
        ("arm.xml", "an XML text, the path .* 'arm.xml'.$"),
        (tmp_path, "and the file to be there"),
        (tmp_path / "empty.xml", "a model that MuJoCo accepts"),
        (12, "an XML text, the path"),
        ("<arm", "a model in XML: .*[^\\n]$"),
        ("<a>" * 9999, "a model in XML: .{,200}$"),
    ):
        with pytest.raises(ValueError, match=f"^source: expected .*{words}"):
            fj.from_mjcf(source)
    for name, keywords in {
        "drop: expected kinds among": dict(drop=("wheels",)),
        "tip: expected a site or a body among": dict(tip="nose"),
        "drop: expected a tuple": dict(drop=None),
        r"controls: .*finite numbers of shape \(0,\)": dict(controls=[1]),
    }.items():
        with pytest.raises(ValueError, match=name):
            fj.from_mjcf(CART_POLE, **keywords)


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
@pytest.mark.filterwarnings(REDUNDANT)
def test_contacts_are_refused_at_the_start_and_told_where_they_may_come(inside, welded):
    geom = '<geom name="of {0}" size=".5"/>'
    body = f'<body name="{{0}}" pos="{{2}} 0 {{2}}">{{1}}{geom}{{3}}</body>'
    hinge = '<joint axis="0 1 0"/>'

    def chain(distance):
        bodies = ""
        for name in "cba":
            joint = "" if name == welded else hinge
            bodies = body.format(name, joint, distance, bodies)
        return f"<mujoco>{inside}<worldbody>{bodies}</worldbody></mujoco>"

    # All geoms overlap, so that MuJoCo reports the contacts that it lets happen.
    model, data = in_mujoco(chain(0))
    mujoco.mj_forward(model, data)
    if data.ncon:
        with pytest.raises(ValueError, match="a contact; drop=.'contacts',"):
            fj.from_mjcf(chain(0))
    apart = chain(0 if 'size="9"' in inside else 9)
    drop = ("contacts",) if 'size="9"' in inside else ()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        account = str(fj.from_mjcf(apart, drop=drop).account)
    about = [w for w in caught if "contacts are left out" in str(w.message)]
    assert len(about) == (data.ncon > 0 and not drop)
    assert all(w.filename == __file__ for w in about)
    assert ("contact" in account) == (data.ncon > 0)


def test_the_account_tells_ranges_that_hold_for_one_control_alone():
    motor = '<motor joint="a" gear="2" forcerange="-.5 .5" ctrlrange="-9 9"/>'
    text = f"""<mujoco><worldbody><body><joint name="a" axis="0 -1 0"/>
    <geom size=".1" pos="1 0 0"/></body></worldbody><actuator>{motor}</actuator>
    </mujoco>"""
    model = fj.from_mjcf(text, controls=[5.0])
    (effort,) = model.forces
    assert effort.tau.tolist() == [1.0]  # 2 times 0.5
    words = dict(model.account.lines)["actuator 0"]
    assert "its range, -9 to 9, is not kept for others" in words
    assert "its force range, -0.5 to 0.5, is not kept for others" in words
