"""Models as people write them: with comments, plugins and parts that ROS allows."""

import mjcf_oracle
import mujoco
import numpy as np
import pytest
from mjcf_texts import (
    BASE,
    ELBOW,
    GEAR,
    NEWER,
    PART,
    arm,
    cart_pole,
    joint,
    link,
    robot,
)

import fdof_jax as fj

pytestmark = pytest.mark.filterwarnings("ignore:source. contacts are left out")

# fmt: off
ROBOT = robot(BASE, *PART)
INERTIAL = '<inertial pos=".2 0 .05" mass="1.5" diaginertia=".01 .02 .02"/>'
BALL = '<collision><geometry><sphere radius=".2"/></geometry></collision>'
WEIGHTLESS = '<link name="a"/>'
LIGHT = link("a", 1e-14).replace(".02", "2e-14").replace(".03", "2e-14").replace(
    ".04", "2e-14").replace(".002", "0").replace("-.001", "0")
BOB = ('<link name="{}"><inertial><origin xyz=".3 .1 -.2"/><mass value="{}"/>'
    '<inertia ixx="{m}" iyy="{m}" izz="{m}" ixy="0" ixz="0" iyz="0"/></inertial>'
    '</link>')
TURNS = joint("continuous", "base", "a"), joint("continuous", "a", "b", ".4 0 .1")
LOCK = '<equality><joint joint1="{}" polycoef="{} 0 0 0 0"/></equality>'
PULLED = ('<tendon><fixed name="t" stiffness="{}" damping="{}" springlength="{}">'
    '<joint joint="shoulder" coef="1"/><joint joint="elbow" coef="{}"/></fixed>'
    '</tendon>')
HEAD = '<compiler angle="radian"/>'
SCARA = ('<mujoco><worldbody><body><joint axis="0 0 1" damping="1"/><geom '
    'type="capsule" fromto="0 0 0 .3 0 0" size=".03"/><body pos=".3 0 0"><joint '
    'axis="0 0 1"/><geom type="capsule" fromto="0 0 0 .2 0 0" size=".02"/><body '
    'pos=".2 0 0">{}<geom size=".02"/></body></body></body></worldbody>{}</mujoco>')
RISE = '<joint name="z" type="slide" axis="0 0 1"/>'
BAR = """<collision><origin xyz="0 0 .45"/><geometry><box size=".1 .1 1"/></geometry>
    </collision><visual><geometry><box size=".1 .1 1"/></geometry>
    <material name="black"/></visual><inertial><origin xyz="0 0 .45"/><mass value="1"/>
    <inertia ixx=".08" ixy="0" ixz="0" iyy=".08" iyz="0" izz=".002"/></inertial>"""
BARS = f"""<?xml version="1.0" ?>
<!-- =========================================================================== -->
<!-- | This document was written by a macro -- edits by hand will be lost      | -->
<!-- =========================================================================== -->
<robot name="two_bars" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <material name="black"><color rgba="0 0 0 1"/></material>
  <gazebo><plugin filename="libgazebo_ros_control.so" name="control">
    <robotNamespace>/two_bars</robotNamespace></plugin></gazebo>
  <gazebo reference="bar2"><mu1>0.2</mu1><material>Gazebo/Black</material></gazebo>
  <link name="world"/>
  <joint name="fixed" type="fixed"><parent link="world"/><child link="bar1"/></joint>
  <link name="bar1">{BAR}</link>
  <joint name="joint1" type="continuous"><parent link="bar1"/><child link="bar2"/>
    <origin rpy="0 0 0" xyz="0 .1 1.95"/><axis xyz="0 1 0"/>
    <dynamics damping=".7"/></joint>
  <link name="bar2">{BAR}</link>
  <joint name="joint2" type="continuous"><parent link="bar2"/><child link="bar3"/>
    <origin rpy="0 0 0" xyz="0 .1 .9"/><axis xyz="0 1 0"/>
    <dynamics damping=".7"/></joint>
  <link name="bar3">{BAR}</link>
  <joint name="camera_joint" type="fixed"><axis xyz="0 1 0"/><origin xyz=".05 0 .9"/>
    <parent link="bar3"/><child link="camera"/></joint>
  <link name="camera"><visual><geometry><mesh filename="package://two/cam.dae"/>
    </geometry></visual><inertial><mass value="1e-5"/><origin xyz="0 0 0"/><inertia
    ixx="1e-6" ixy="0" ixz="0" iyy="1e-6" iyz="0" izz="1e-6"/></inertial></link>
  <transmission name="tran1"><type>transmission_interface/SimpleTransmission</type>
    <joint name="joint1"><hardwareInterface>Effort</hardwareInterface></joint>
  </transmission>
</robot>"""
CART = cart_pole('<actuator><motor joint="slider" gear="20"/></actuator>')

# By name: a text, and one of the same arm that MuJoCo reads (the same one, if None).
TEXTS: dict[str, tuple[str, str | None]] = {
    "rules in comments": (CART.replace("<worldbody>",
        "<!-- ---- links ---- -->\n<!-- <body> --->\n<!-- a & b --><worldbody>"), None),
    "ampersand in a name": (arm(last='<site name="pen & tip" pos=".1 0 0"/>'), None),
    "letters of Europe": (CART.replace("<worldbody>", "<!-- Länge: é --><worldbody>"),
        None),
    "name space of MJCF": (CART.replace("<mujoco>", '<mujoco xmlns="http://mujoco.org">'),
        CART),
    "declaration after a line": ('\n<?xml version="1.0" encoding="UTF-8"?>\n<!-- -- -->'
        + ROBOT.partition("?>")[2], ROBOT),
    "rules in comments of a robot": (ROBOT.replace(BASE,
        f"<!-- -- base -- -->{BASE}<!---------->"), None),
    "letters of Europe in a robot": (ROBOT.replace("?>",
        ' encoding="ISO-8859-1"?><!-- Gelenk für Käfer -->'), ROBOT),
    "plugin of Gazebo": (ROBOT.replace(BASE, BASE + '<gazebo><plugin name="control" '
        'filename="libgazebo_ros_control.so"><file>/etc/hostname</file></plugin></gazebo>'),
        None),
    "prefix without a declaration": (ROBOT.replace(BASE, BASE + '<controller:pid p="3">'
        '<sensor:imu/></controller:pid>'), None),
    "name space of a robot": (ROBOT.replace('name="arm"', 'name="arm" xmlns="http://ros.org"'
        ' xmlns:xacro="http://ros.org/xacro"'), ROBOT),
    "tutorial of two bars": (BARS, None),
    "transmissions and safety": (ROBOT.replace("<limit", '<safety_controller '
        'k_velocity="9" soft_lower_limit="-1"/><calibration rising="0"/><limit')
        .replace(BASE, BASE + GEAR), ROBOT),
    "undeclared world": (robot(link("base"), joint("fixed", "world", "base", "0 0 1",
        ""), *PART), ROBOT),
    "neighbours that overlap": (robot(BASE.replace("/>", f">{BALL}</link>"),
        link("a", visual=BALL), link("b", .5, visual=BALL), *PART[2:]), ROBOT),
    "empty geometry": (robot(BASE, link("a", visual="<collision><geometry/></collision>"
        "<visual><geometry></geometry></visual><collision/>"), *PART[1:]), ROBOT),
    "link without mass": (robot(BASE, WEIGHTLESS, link("b"), *TURNS),
        robot(BASE, LIGHT, link("b"), *TURNS)),
    "link of mass 0": (robot(BASE, BOB.format("a", 0, m=0), link("b"), *TURNS),
        robot(BASE, LIGHT, link("b"), *TURNS)),
    "point masses": tuple(robot(BASE, BOB.format("a", 2, m=m), BOB.format("b", 1, m=m),
        *TURNS) for m in ("0", "2e-14")),
    "mass without inertia": (robot(BASE, '<link name="a"><inertial><origin xyz=".3 .1 '
        '-.2"/><mass value="2"/></inertial></link>', link("b"), *TURNS), robot(BASE,
        BOB.format("a", 2, m="2e-14"), link("b"), *TURNS)),
    "locked elbow": (arm("damping='1'", head=HEAD, tail=LOCK.format("elbow", .4)),
        arm("damping='1'", head=HEAD).replace('<joint name="elbow" axis="0 1 0" />', "")
        .replace('name="lower" pos', 'name="lower" euler="0 .4 0" pos')),
    "locked shoulder with a reference": (arm("ref='.3'", head=HEAD, tail=LOCK.format(
        "shoulder", -.7)), arm(head=HEAD, turn='euler="0 -.7 0"').replace(
        '<joint name="shoulder" axis="0 1 0" />', "")),
    "scara with a locked slide": (SCARA.format(RISE, LOCK.format("z", 0)),
        SCARA.format("", "")),
    "spring on two joints": (arm(tail=PULLED.format(8, .3, ".5", -2)), None),
    "spring with a dead band": (arm(tail=PULLED.format(30, 0, "-.2 .3", 1.5),
        axes=("0 1 0", "0 -1 0")), None),
    "damper on two joints": (arm(tail=PULLED.format(0, 2, "-1", 1)), None),
}
if not NEWER:
    del TEXTS["name space of MJCF"]  # which MuJoCo did not read
# fmt: on


@pytest.mark.parametrize("name", TEXTS)
def test_texts_accelerate_as_in_mujoco_by_path_and_by_text(name, tmp_path):
    text, plain = TEXTS[name]
    model = mujoco.MjModel.from_xml_string(plain or text)
    path = tmp_path / "arm.xml"
    path.write_text(text, encoding="latin-1" if "Europe" in name else "utf-8")
    for source in (text, path):
        read = lambda controls, source=source: fj.from_mjcf(source, controls=controls)
        rng = np.random.default_rng(0)
        assert mjcf_oracle.compare(model, read, rng, 10) < 1e-11


@pytest.mark.slow
@pytest.mark.parametrize("name", TEXTS)
def test_texts_move_as_in_mujoco(name):
    text, plain = TEXTS[name]
    model = mujoco.MjModel.from_xml_string(plain or text)
    read = lambda controls: fj.from_mjcf(text, controls=controls)
    assert mjcf_oracle.compare_motion(model, read) < 1e-7


REFUSED = {
    "joint a-b, which mimics joint base-a": ROBOT.replace(
        ELBOW, ELBOW.replace("<limit", '<mimic joint="base-a" multiplier="2"/><limit')
    ),
    "declared link as child of joint a-b, got 'b'": ROBOT.replace(
        '<link name="b"', '<link name="c"'
    ),
    "declared link as parent of joint a-b, got 'A'": ROBOT.replace(
        '<parent link="a"', '<parent link="A"'
    ),
    "and not xacro: .xacro arm.xacro > arm.urdf": robot(
        '<xacro:include filename="/etc/hostname"/>'
    ),
    "a model, and not xacro": ROBOT.replace('value="1.0"', 'value="${m}"'),
    "joint 2 .revolute. of RR to move some inertia": robot(
        BASE, link("a"), '<link name="b"/>', *TURNS
    ),
    "without entities": '<!DOCTYPE a [<!ENTITY b "cc"><!ENTITY d "&b;&b;">]><mujoco>'
    '<worldbody><body name="&d;"/></worldbody></mujoco>',
    "joint shoulder with a range that its margins fill": arm(
        'range="-1 1" margin="1"', head='<compiler angle="radian" autolimits="true"/>'
    ),
    "spec.delete.spec.joint.'z'": SCARA.format(RISE, ""),
    "tendon t with a range, which joints alone have here": arm(
        tail=PULLED.format(1, 0, "0", 1).replace("<fixed", '<fixed range="-1 1"'),
        head='<compiler autolimits="true"/>',
    ),
    "joints that are all locked": arm(
        tail=LOCK.format("shoulder", 0) + LOCK.format("elbow", 0)
    ),
    "equality 1 with a loop": arm(
        tail=LOCK.format("elbow", 0)
        + '<equality><joint joint1="elbow" joint2="shoulder"/></equality>'
    ),
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_is_not_read_is_named(words):
    with pytest.raises(ValueError, match=f"^source: expected .*{words}"):
        fj.from_mjcf(REFUSED[words])


def test_the_account_tells_what_was_added_and_left_out():
    for name, words in {
        "undeclared world": "link world added, as parent of joint world-base",
        "neighbours that overlap": "left out between the ground and the first link",
        "plugin of Gazebo": "left out: gazebo of robot arm",
        "prefix without a declaration": "left out: controller:pid of robot arm",
        "locked elbow": "joint elbow is fixed at 0.4",
        "spring on two joints": "Actuators, that act as its spring and damper",
    }.items():
        assert words in str(fj.from_mjcf(TEXTS[name][0]).account)
    # Of MJCF, as in MuJoCo, the ground and the first link do collide.
    ball = '<geom size=".2"/>'
    with pytest.raises(ValueError, match="a contact"):
        fj.from_mjcf(arm(world=ball))


def test_a_missing_mesh_of_a_body_whose_mass_is_given(tmp_path):
    meshes = '<asset><mesh file="hull.stl"/><mesh name="n" file="{}"/></asset>'
    head = '<compiler meshdir="parts"/>' + meshes.format("other/skin.obj")
    shapes = '<geom type="mesh" mesh="hull"/><geom type="mesh" mesh="n" mass="2"/>'
    text = arm(head=head, between=INERTIAL + shapes, last='<site name="tip"/>')
    path = tmp_path / "arm.xml"
    path.write_text(text)
    model = mujoco.MjModel.from_xml_string(
        arm(between=INERTIAL, last='<site name="tip"/>')
    )
    read = lambda controls: fj.from_mjcf(path, controls=controls)
    assert mjcf_oracle.compare(model, read, np.random.default_rng(0), 10) < 1e-11
    assert "left out: mesh hull, which is not there" in str(read(None).account)
    with pytest.raises(ValueError, match="names no other files"):
        fj.from_mjcf(text)
    for wrong in (
        text.replace(INERTIAL, ""),
        text.replace("<compiler", '<compiler inertiafromgeom="true"'),
    ):
        path.write_text(wrong)
        with pytest.raises(ValueError, match="MuJoCo accepts: .*hull.stl"):
            fj.from_mjcf(path)


def test_no_file_is_opened_that_was_not_asked_for(tmp_path, monkeypatch):
    """Not even those that are beside a robot, in parts that are not read."""
    names = ("control.so", "picture.stl", "hidden.stl")
    for name in names:
        (tmp_path / name).write_bytes(b"")
    path, opened = tmp_path / "arm.urdf", []
    path.write_text(
        ROBOT.replace(
            BASE,
            '<gazebo><plugin filename="control.so"/></gazebo><!-- -- <mesh '
            'filename="hidden.stl"/> --><link name="base"><visual><geometry><mesh '
            'filename="picture.stl"/></geometry></visual></link>',
        )
    )
    read = type(path).read_bytes
    note = lambda self: opened.append(self) or read(self)
    monkeypatch.setattr(type(path), "read_bytes", note)
    fj.from_mjcf(path)
    assert opened == [path]


def test_a_robot_needs_a_mujoco_that_turns_inertias_rightly(monkeypatch):
    """Older ones took the products of a turned inertia for those of another frame."""
    monkeypatch.setattr(mujoco, "__version__", "3.13.2")
    with pytest.raises(ImportError, match="3.14 or newer"):
        fj.from_mjcf(ROBOT)
    fj.from_mjcf(CART)


def test_a_turned_inertia_is_that_of_its_axes():
    """Of a hinge about y, after turns about x and z."""
    x, z = 0.1, 0.2  # of `link`
    about_x = [[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]]
    about_z = [[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]]
    axis = (np.array(about_z) @ about_x)[1]
    inertia = [[0.02, 0.002, 0], [0.002, 0.03, -0.001], [0, -0.001, 0.04]]
    text = robot(BASE, link("a"), joint("continuous", "base", "a"))
    arm = fj.from_mjcf(text).linkage
    np.testing.assert_allclose(arm.inertia, [axis @ inertia @ axis], rtol=1e-14)
