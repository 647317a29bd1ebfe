"""Models of MuJoCo and ROS that `from_mjcf` reads or refuses. All texts are our own."""

from typing import NamedTuple

import mujoco

NEWER = hasattr(mujoco.mjtDyn, "mjDYN_PID")  # whether MuJoCo has the newest actuators

# fmt: off


def mjcf(world, *, head="", tail=""):
    return f"<mujoco>{head}<worldbody>{world}</worldbody>{tail}</mujoco>"


def arm(first="", second="", *, axes=("0 1 0",) * 2, last="", turn="", between="",
        world="", **rest):
    """Two links in a plane, with attributes of joints and of the first body."""
    return mjcf(
        f'{world}<body name="upper" {turn}>'
        f'<joint name="shoulder" axis="{axes[0]}" {first}/>{between}<geom name="upper" '
        'type="capsule" fromto="0 0 0 .4 0 .1" size=".04"/><body name="lower" pos='
        f'".4 0 .1"><joint name="elbow" axis="{axes[1]}" {second}/><geom name="lower" '
        f'type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>{last}</body></body>',
        **rest)


OPPOSITE = ("0 1 0", "0 -1 0")
RADIAN = '<compiler angle="radian"/>'


def actuated(*actuators, joints="", key=""):
    tail = "".join(f"<{actuator}/>" for actuator in actuators)
    tail = f"<actuator>{tail}</actuator>{key}"
    return arm(joints, joints, axes=OPPOSITE, tail=tail)


def wedge(size):
    """Returns a tetrahedron at a corner of a cube, as an OBJ file."""
    corners = f"v 0 0 0\nv {size} 0 0\nv 0 {size} 0\nv 0 0 {size}\n"
    return corners + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


class Text(NamedTuple):
    """A model that is read; `drop` is what is left out on purpose."""

    text: str
    joints: int = 2  # of the arm
    drop: tuple = ()
    tolerance: float = 1e-11  # of accelerations, relative
    files: dict = {}  # further ones, by name


FIRST, SECOND = 'joint="shoulder"', 'joint="elbow"'
SLIDE = ('<body pos=".3 0 .1"><joint type="slide" axis="{}" damping="{}"/><geom '
    'size=".05"/>{}</body>')
PAIR = '<body pos="0 {} 0"><joint name="{}" axis="0 1 0"/><geom size=".1"/></body>'
BESIDE = ('<body pos="0 0 3"><freejoint/><geom size=".1"/></body><body mocap="true" '
    'pos="1 0 1"><geom size=".02" contype="0" conaffinity="0"/></body>' +
    PAIR.format(2, "u") + PAIR.format(4, "v"))
BODIES = arm()[len("<mujoco><worldbody>"):-len("</worldbody></mujoco>")]
PULLED = ('<fixed name="{}" stiffness="{}" damping="{}" springlength="{}"><joint '
    'joint="shoulder" coef="1"/><joint joint="elbow" coef="{}"/></fixed>')
TEXTS = {
    "target on slides, gravity across": Text("""<mujoco><compiler angle="radian"/>
<default><joint armature="1" damping="1"/><geom contype="0"/></default><worldbody>
<geom conaffinity="0" size="1 1 10" type="plane"/><body name="near" pos="0 0 .01"><geom
fromto="0 0 0 .1 0 0" size=".01" type="capsule"/><joint axis="0 0 1"/><body pos="0.1 0
0"><joint name="elbow" axis="0 0 1" range="-2.9 2.9"/><geom fromto="0 0 0 .12 0 0"
size=".01" type="capsule"/></body></body><body pos=".1 -.1 .01"><joint axis="1 0 0"
ref=".1" type="slide"/><joint axis="0 1 0" ref="-.1" type="slide"/><geom
size=".01"/></body></worldbody><actuator><motor ctrlrange="-1 1" gear="150"
joint="elbow"/></actuator></mujoco>"""),
    "slides alone": Text(mjcf(SLIDE.format("1 0 0", 1, SLIDE.format("0 0 1", 2,
        SLIDE.format("1 0 .7", 3, SLIDE.format("1 0 -2", 4, ""))))), 4),
    "no hinge, gravity across": Text(mjcf('<body><joint type="slide" axis="1 0 0"/>'
        '<joint type="slide" axis="0 1 0" damping="2"/><geom size=".01" mass=".3"/>'
        '</body>')),
    "rounded right angles": Text(arm(turn='euler="1.5708 0 0"', head=RADIAN,
        axes=("0 0 1", "0 1 0")).replace('name="lower" pos',
        'name="lower" euler="-1.5708 0 0" pos'), tolerance=1e-5),
    "thin air": Text(arm(head='<option density="1e-9"/>')),
    "all dropped": Text(arm('stiffness="20"', 'range="-1 1" frictionloss="1"',
        world='<site name="p"/>', last='<site name="q"/>', head='<option '
        'density="1.2" viscosity="2e-5"/>', tail='<tendon><spatial name="t" '
        'stiffness="4" limited="true" range="0 9" frictionloss="1"><site site="p"/>'
        '<site site="q"/></spatial></tendon><equality><joint joint1="shoulder" '
        'joint2="elbow"/></equality><actuator><motor tendon="t"/></actuator>'),
        drop=("springs", "limits", "friction", "fluid", "tendons", "equalities",
        "actuators")),
    "on a mocap body": Text(mjcf(f'<body mocap="true">{BODIES}</body>', tail=
        '<keyframe><key mpos="0 0 1" mquat=".9 0 .4 0" qpos=".1 .2"/></keyframe>')),
    "bodies beside": Text(arm(world=BESIDE, tail='<tendon><fixed limited="true" '
        'range="-1 1"><joint joint="u" coef="1"/><joint joint="v" coef="1"/></fixed>'
        '</tendon><equality><joint joint1="u" joint2="v"/></equality>')),
    "several joints in a body, in a turned plane": Text(mjcf("""<body quat=".8 .3 -.4
.2"><joint type="slide" axis="1 0 2" ref=".2" stiffness="30"/><joint axis="0 -1 0" pos=
".1 0 .1" ref="10" stiffness="9" springref="-30"/><inertial mass="2" pos=".2 .1 0" quat=
".9 .1 .2 .1" diaginertia=".03 .028 .008"/><body pos=".1 0 0" euler="20 -60 10">
<inertial mass=".7" pos=".1 0 0" fullinertia=".01 .04 .045 .002 -.003 .001"/></body>
<body pos=".4 .1 0" euler="0 30 0"><joint axis="0 -1 0" damping=".3" armature=".1"/>
<joint type="slide" axis="1 0 .2" damping="1"/><geom type="box" size=".3 .1 .2"
pos=".1 0 -.1"/><body pos="0 0 -.2"><geom size=".1" mass="2"/></body></body></body>""",
        head='<option gravity="3 2 -5"><flag contact="disable"/></option>'), 4),
    "actuators of each kind": Text(actuated(
        f'velocity {FIRST} kv="5" ctrlrange="-2 2"',
        f'damper {SECOND} kv="2" ctrlrange="0 5" gear="2"',
        f'intvelocity {FIRST} kp="30" kv="1" actrange="-1 .7"',
        f'position {SECOND} kp="30" dampratio=".7" gear="-2" timeconst=".05" '
        'forcerange="-4 3"',
        f'general {FIRST} gainprm="3" biastype="affine" biasprm="1 -3 -1" '
        'dyntype="filter" dynprm=".1"',
        f'general {SECOND} gaintype="affine" gainprm="3 1 -.5" ctrlrange="0 2"',
        joints='armature=".1"')),
    "servos and motors": Text(actuated(f'position {FIRST} kp="9" kv="1" gear="-2"',
        f'velocity {FIRST} kv="3" gear="2"', f'position {SECOND} kp="20" gear="-3" '
        'forcerange="-4 4"', f'motor {SECOND} gear="-2.5" forcerange="-.5 .3"')),
    "a limited joint that both pull": Text(actuated(f'motor {FIRST} gear="9"',
        f'position {FIRST} kp="20" kv="1"', joints='actuatorfrcrange="-3 2"')),
    "state in a key frame": Text(actuated(f'position {FIRST} kp="40" timeconst=".2"',
        key='<keyframe><key qpos=".1 .2" act=".3" ctrl="-.4"/></keyframe>')),
    "tendons of each kind": Text(arm(world='<site name="p" pos=".2 .1 1"/>', between=
        '<site name="q" pos=".2 .1 .1"/>', last='<site name="r" pos=".25 .1 .05"/>',
        tail="<tendon>" + "".join(f'<spatial {kind}><site site="{to}"/><site site="r"/>'
        "</spatial>" for kind, to in (('stiffness="50" springlength=".3"', "p"),
        ('stiffness="20" springlength="0 .6"', "p"), ('stiffness="9"', "p"),
        ('stiffness="40" springlength=".5 9"', "p"), ('stiffness="30" damping="4" '
        'springlength=".2 .3"', "q"))) + "</tendon>")),
    "springs on two joints": Text(arm(axes=OPPOSITE, tail="<tendon>" + PULLED.format(
        "a", 8, .3, ".5", -2) + PULLED.format("b", 30, 0, "-.2 .3", 1.5) +
        PULLED.format("c", 0, 2, "-1", 1) + "</tendon>")),
    "included pole": Text(mjcf('<body><joint type="slide" axis="1 0 0"/><geom '
        'size=".1"/><include file="pole.xml"/></body>'), files={"pole.xml":
        '<mujocoinclude><body><joint axis="0 1 0"/><geom type="capsule" size=".04" '
        'fromto="0 0 0 0 0 .6"/></body></mujocoinclude>'}),
    "link from a mesh": Text(arm(head='<asset><mesh name="m" file="part.obj" '
        'scale="1 .5 2"/></asset>', last='<geom type="mesh" mesh="m" density="300" '
        'contype="0" conaffinity="0"/>'), files={"part.obj": wedge(.3)}),
}
if NEWER:
    TEXTS |= {
        "pid of a position alone": Text(actuated(f'pid {FIRST} kp="30" kv="2" ki="5" '
            'imax=".3"', f'pid {SECOND} kp="9" ki="3" kv="1" input="pos"', f'dcmotor '
            f'{SECOND} motorconst=".1" resistance="4" gear="-20"')),
        "damping and armature of actuators": Text(actuated(f'dcmotor {FIRST} '
            'motorconst=".05" resistance="2" inductance=".02" gear="100" '
            'damping="1e-4" armature="1e-5"', f'motor {SECOND} '
            'damping=".2" armature=".1" gear="2"')),
    }

# URDF


def link(name, mass=1.0, inside=""):
    return (f'<link name="{name}"><inertial><origin xyz=".2 0 .05" rpy=".1 0 .2"/>'
        f'<mass value="{mass}"/><inertia ixx=".02" iyy=".03" izz=".04" ixy=".002" '
        f'ixz="0" iyz="-.001"/></inertial>{inside}</link>')


def joint(kind, parent, child, at="0 0 0", axis="0 1 0", inside=""):
    axis = f'<axis xyz="{axis}"/>' if axis else ""
    if kind != "fixed":
        inside += '<limit lower="-1" upper="1.2" effort="50" velocity="3"/>'
    return (f'<joint name="{parent}-{child}" type="{kind}"><parent link="{parent}"/>'
        f'<child link="{child}"/><origin xyz="{at}"/>{axis}{inside}</joint>')


def robot(*parts):
    return '<?xml version="1.0"?><robot name="arm">' + "".join(parts) + "</robot>"


BASE = '<link name="base"/>'
ELBOW = joint("revolute", "a", "b", ".4 0 .1", "0 -1 0",
    '<dynamics damping=".2" friction=".1"/>')
PART = link("a"), link("b", 0.5), joint("revolute", "base", "a"), ELBOW
ROBOT = robot(BASE, *PART)
TURNS = joint("continuous", "base", "a"), joint("continuous", "a", "b", ".4 0 .1")
SHAPE = ('<collision><origin xyz=".1 0 0" rpy="0 1.5708 0"/><geometry><cylinder '
    'radius=".02" length=".2"/></geometry></collision>')
PICTURE = '<visual><geometry><mesh filename="package://arm/a.dae"/></geometry></visual>'
BALL = '<collision><geometry><sphere radius=".2"/></geometry></collision>'
TEXTS |= {
    "urdf": Text(ROBOT),
    "urdf of turning joints": Text(robot(BASE, *(link(name, inside=SHAPE) for name in
        "abcd"), joint("continuous", "base", "a", axis=None), joint("fixed", "a", "b",
        ".1 0 0"), joint("continuous", "b", "c", "0 .1 .3", "1 0 0"), joint("revolute",
        "c", "d", "0 .3 0", "-1 0 0")), 3),
    "urdf without its pictures": Text(robot(BASE, link("a", inside=PICTURE + SHAPE),
        *PART[1:], link("c"), joint("revolute", "b", "c", '.3 0 0" rpy="1.5708 0 0',
        "0 0 1")), 3, tolerance=1e-5),
}

# What people write, and a text that is read alike

PLUGIN = ('<gazebo><plugin name="control" filename="libgazebo_ros_control.so"><file>'
    '/etc/hostname</file></plugin></gazebo>')
WORLD = ('<link name="world"/>', link("base"), joint("fixed", "world", "base", "0 0 1",
    ""))
WEIGHTLESS = '<link name="a"/>'
BOB = ('<link name="{}"><inertial><origin xyz="{at}"/><mass value="{}"/><inertia '
    'ixx="{m}" iyy="{m}" izz="{m}" ixy="0" ixz="0" iyz="0"/></inertial></link>')
LIGHT = BOB.format("a", 1e-14, m="2e-14", at="0 0 0")
LOCK = '<equality><joint joint1="{}" polycoef="{} 0 0 0 0"/></equality>'
FREE = '<joint name="{}" axis="0 1 0" />'
SCARA = ('<mujoco><worldbody><body><joint axis="0 0 1" damping="1"/><geom '
    'type="capsule" fromto="0 0 0 .3 0 0" size=".03"/><body pos=".3 0 0"><joint '
    'axis="0 0 1"/><geom type="capsule" fromto="0 0 0 .2 0 0" size=".02"/><body '
    'pos=".2 0 0">{}<geom size=".02"/></body></body></body></worldbody>{}</mujoco>')
RISE = '<joint name="z" type="slide" axis="0 0 1"/>'
ALIKE = {
    "rules in comments": (arm().replace("<worldbody>",
        "<!-- -- links -- -->\n<!-- <body> --->\n<!-- a & b --><worldbody>"), arm()),
    "ampersand in a name": (arm(last='<site name="pen & tip" pos=".1 0 0"/>'), arm()),
    "declaration after a line": ('\n<?xml version="1.0" encoding="UTF-8"?>\n<!-- -- -->'
        + ROBOT.partition("?>")[2], ROBOT),
    "letters of Europe in a robot": (ROBOT.replace("?>",
        ' encoding="ISO-8859-1"?><!-- Gelenk für Käfer -->'), ROBOT),
    "plugin of Gazebo": (ROBOT.replace(BASE, BASE + PLUGIN), ROBOT),
    "prefix without a declaration": (ROBOT.replace(BASE, BASE + '<controller:pid p="3">'
        '<sensor:imu/></controller:pid>'), ROBOT),
    "name space of a robot": (ROBOT.replace('name="arm"', 'name="arm" xmlns="http://ros.org"'
        ' xmlns:xacro="http://ros.org/xacro"'), ROBOT),
    "undeclared world": (robot(*WORLD[1:], *PART), robot(*WORLD, *PART)),
    "neighbours that overlap": (robot(BASE.replace("/>", f">{BALL}</link>"),
        link("a", inside=BALL), link("b", .5, BALL), *PART[2:]), ROBOT),
    "empty geometry": (robot(BASE, link("a", inside="<collision><geometry/></collision>"
        "<visual><geometry></geometry></visual><collision/>"), *PART[1:]), ROBOT),
    "link without mass": (robot(BASE, WEIGHTLESS, link("b"), *TURNS),
        robot(BASE, LIGHT, link("b"), *TURNS)),
    "mass without inertia": (robot(BASE, '<link name="a"><inertial><mass value="2"/>'
        '</inertial></link>', link("b"), *TURNS), robot(BASE, BOB.format("a", 2,
        m="2e-14", at="0 0 0"), link("b"), *TURNS)),
    "locked shoulder with a reference": (arm("ref='.3'", head=RADIAN, tail=LOCK.format(
        "shoulder", -.7)), arm(head=RADIAN, turn='euler="0 -.7 0"').replace(
        FREE.format("shoulder"), "")),
    "scara with a locked slide": (SCARA.format(RISE, LOCK.format("z", 0)),
        SCARA.format("", "")),
}
# Refused: a pattern of the message, and models


def nested(count, inside=""):
    body = '<body pos=".1 0 0"><joint axis="0 1 0"/><geom size=".03" contype="0"/>'
    return mjcf(count * body + inside + count * "</body>")


LEAF = '<body pos="0 0 .2"><joint axis="0 1 0"/><geom size=".03" contype="0"/></body>'
SITES = dict(world='<site name="p" pos="0 0 1"/><body pos="1 0 0"><joint type="slide" '
    'axis="1 0 0"/><geom size=".1"/><site name="b"/></body>',
    between='<site name="q" pos=".2 0 .2"/>', last='<site name="r" pos=".2 0 0"/>')
COUPLED = '<joint joint="shoulder" coef="1"/><joint joint="elbow" coef="1"/>'


def on_tendon(attributes, inside, more=""):
    kind = "spatial" if "site" in inside else "fixed"
    tail = f'<tendon><{kind} name="t" {attributes}>{inside}</{kind}></tendon>{more}'
    return arm(head='<compiler autolimits="true"/>', tail=tail, **SITES)


PUSHED = '<actuator><motor tendon="t"/></actuator>'
REFUSED = {
    "1 to 8 letters": nested(9),
    "ball.*neither a hinge nor a slide": nested(1, LEAF.replace('axis="0 1 0"',
        'name="ball" type="ball"')),
    "branches: bodies .* both follow": nested(1, LEAF + LEAF),
    "a loop or another constraint": arm(tail='<equality><connect body1="lower" '
        'anchor=".3 0 0"/></equality>'),
    "equality 1 with a loop": arm(tail=LOCK.format("elbow", 0) + '<equality><joint '
        'joint1="elbow" joint2="shoulder"/></equality>'),
    "joints that are all locked": arm(tail=LOCK.format("shoulder", 0) +
        LOCK.format("elbow", 0)),
    "a transmission .tendon. beyond": on_tendon("", '<site site="p"/><site site="q"/>'
        '<site site="r"/>', PUSHED),
    "tendon t with a spring": on_tendon('stiffness="9"', '<site site="r"/>'
        '<site site="b"/>'),
    "tendon t with a range": on_tendon('range="-1 1"', COUPLED),
    "limit of actuator forces": on_tendon('actuatorfrcrange="-1 1"', COUPLED,
        PUSHED),
    "muscle": actuated('muscle joint="elbow" lengthrange="-1 1"'),
    "names no other files, got '/etc/hostname'": arm(
        world='<include file="/etc/hostname"/>'),
    "the axis of joint elbow along": arm(axes=("0 1 0", "0 .995 .0998")),
    "the axis of joint elbow in the plane": arm(second='type="slide"'),
    "spec.delete.spec.joint.'z'": SCARA.format(RISE, ""),
    "without joints": mjcf('<body mocap="true"><geom size=".1"/></body>'),
    "finite gravity": arm(head='<option gravity="0 0 nan"/>'),
    "a finite start": arm(tail='<keyframe><key qpos="nan 0"/></keyframe>'),
    "without entities": '<!DOCTYPE mujoco [<!ENTITY a "><mujoco><include '
        'file=\'/etc/hostname\'/></mujoco><!--"> ]><mujoco/><!-- -->',
    "nested too deep": f"<robot>{20000 * '<mujoco>'}{20000 * '</mujoco>'}</robot>",
    "a plugin": arm(head='<extension><plugin plugin="mujoco.pid"><instance name="p">'
        '<config key="kp" value="4"/></instance></plugin></extension>', tail=
        '<actuator><plugin joint="elbow" plugin="mujoco.pid" instance="p"/></actuator>'
        ),
    "a fluid of density 1000": arm(head='<option density="1000" viscosity=".001"/>'),
    "body upper with compensated gravity": arm(turn='gravcomp=".5"'),
    "a model that MuJoCo accepts": mjcf("<nothing/>"),
    "joint shoulder with a range that its margins fill": arm('range="-1 1" margin="1"',
        head='<compiler angle="radian" autolimits="true"/>'),
    "joint a-b, which mimics joint base-a": ROBOT.replace(ELBOW, ELBOW.replace("<limit",
        '<mimic joint="base-a" multiplier="2"/><limit')),
    "declared link as child of joint a-b, got 'b'": ROBOT.replace(
        '<link name="b"', '<link name="c"'),
    "and not xacro: .xacro arm.xacro > arm.urdf": robot(
        '<xacro:include filename="/etc/hostname"/>'),
    "joint 2 .revolute. of RR to move some inertia": robot(
        BASE, link("a"), '<link name="b"/>', *TURNS),
}
if NEWER:
    REFUSED["slew rate"] = actuated('pid joint="elbow" kp="3" slewmax="2"')
if hasattr(mujoco.MjModel, "dof_dampingpoly"):
    REFUSED["joint shoulder with nonlinear damping"] = arm('damping="1 2"')
    REFUSED["joint shoulder with a nonlinear spring"] = arm('stiffness="0 2"')
