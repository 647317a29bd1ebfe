"""Models in the styles of public ones that `from_mjcf` reads or refuses, and random
ones. All texts are the tests' own."""

import struct
from pathlib import Path
from typing import NamedTuple

import mujoco

NEWER = hasattr(mujoco.mjtDyn, "mjDYN_PID")  # whether MuJoCo has the newest actuators


class Text(NamedTuple):
    """A model that is read. Ranges and friction are among its features, if any."""

    name: str
    text: str
    features: tuple[str, ...]
    joints: int  # of the arm
    options: dict = {}  # of from_mjcf
    tolerance: float = 1e-11  # of accelerations, relative
    files: dict = {}  # further ones, by name

    def source(self, folder):
        """Returns the text, or the path to it where it needs further files."""
        if not self.files:
            return self.text
        home = Path(folder) / self.name.replace(" ", "_")
        home.mkdir(exist_ok=True)
        for name, content in self.files.items():
            (home / name).parent.mkdir(exist_ok=True)
            write = Path.write_bytes if isinstance(content, bytes) else Path.write_text
            write(home / name, content)
        path = home / ("arm.urdf" if "<robot" in self.text else "arm.xml")
        path.write_text(self.text)
        return path

    def model(self, folder):
        """Returns MuJoCo's model."""
        source = self.source(folder)
        if isinstance(source, Path):
            return mujoco.MjModel.from_xml_path(str(source))
        return mujoco.MjModel.from_xml_string(source)


TEXTS: list[Text] = []


def add(name, features, joints, text, **rest):
    features = tuple(features.split(", "))
    if NEWER or not {"pid", "dcmotor", "transmission damping"} & {*features}:
        TEXTS.append(Text(name, text, features, joints, **rest))


def mjcf(world, *, head="", tail=""):
    return f"<mujoco>{head}<worldbody>{world}</worldbody>{tail}</mujoco>"


def arm(first="", second="", *, axes=("0 1 0",) * 2, last="", turn="", **rest):
    """Two links in a plane, with attributes of joints and of the first body."""
    between, world = rest.pop("between", ""), rest.pop("world", "")
    return mjcf(
        f'{world}<body name="upper" {turn}>'
        f'<joint name="shoulder" axis="{axes[0]}" {first}/>{between}<geom name="upper" '
        'type="capsule" fromto="0 0 0 .4 0 .1" size=".04"/><body name="lower" pos='
        f'".4 0 .1"><joint name="elbow" axis="{axes[1]}" {second}/><geom name="lower" '
        f'type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>{last}</body></body>',
        **rest,
    )


def cart_pole(tail="", head="", slider="", hinge="", pole=""):
    return mjcf(
        '<body name="cart" pos="0 0 1"><joint name="slider" type="slide" axis="1 0 0" '
        f'{slider}/><geom type="box" size=".2 .15 .1" mass="1"/><body name="pole">'
        f'<joint name="hinge" axis="0 1 0" {hinge}/><geom type="capsule" '
        f'fromto="0 0 0 0 0 .6" size=".045" mass=".1"/>{pole}</body></body>',
        head=head,
        tail=tail,
    )


def box_stl(x, y, z):
    """A box from 0 to (x, y, z), as a binary STL file."""
    corner = lambda k: (x * (k & 1), y * (k >> 1 & 1), z * (k >> 2 & 1))
    faces = (
        (0, 2, 3, 1),
        (4, 5, 7, 6),
        (0, 1, 5, 4),
        (2, 6, 7, 3),
        (0, 4, 6, 2),
        (1, 3, 7, 5),
    )
    triangles = [t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))]
    data = [
        struct.pack("<12fH", 0, 0, 0, *(v for k in triangle for v in corner(k)), 0)
        for triangle in triangles
    ]
    return bytes(80) + struct.pack("<I", len(data)) + b"".join(data)


WEDGE_OBJ = """v 0 0 0\nv .3 0 0\nv 0 .1 0\nv 0 0 .1
f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"""

# fmt: off
# In the styles of Gymnasium

add("rail cart-pole", "slide, limits, damping, defaults, gear, ctrlrange, degrees", 2,
    """<mujoco model="balance"><compiler inertiafromgeom="true"/><size nstack="3000"/>
<default><joint armature="0" damping="1" limited="true"/><geom contype="0"/><tendon/>
<motor ctrlrange="-3 3"/></default><option integrator="RK4" timestep="0.02"/><worldbody>
<geom name="rail" quat="0.707 0 0.707 0" size="0.03 1.2" type="capsule"/><body
name="cart"><joint axis="1 0 0" name="slider" range="-1.2 1.2" type="slide"/><geom
type="capsule" quat="0.707 0 0.707 0" size="0.12 0.1"/><body><joint axis="0 1 0"
name="hinge" range="-95 95"/><geom type="capsule" fromto="0 0 0 0.001 0 0.7" size="0.05"
/></body></body></worldbody><actuator><motor ctrllimited="true" gear="90"
joint="slider"/></actuator></mujoco>""")
add("cart with two poles", "slide, limits, oblique gravity, floor, tip site, margin", 3,
    """<mujoco><default><joint damping="0.04"/><geom contype="0"/></default> <option
gravity="1e-5 0 -9.81"/><worldbody><geom type="plane" pos="0 0 -3" size="40 40 40"/>
<body name="cart"><joint axis="1 0 0" limited="true" margin="0.01" name="slider"
range="-1 1" type="slide"/><geom quat="0.707 0 0.707 0" size="0.1 0.1" type="capsule"/>
<body><joint axis="0 1 0"/><geom fromto="0 0 0 0 0 .55" size=".045" type="capsule"/>
<body pos="0 0 .55"><joint axis="0 1 0"/><geom fromto="0 0 0 0 0 .6" size=".04"
type="capsule"/><site name="tip" pos="0 0
.6"/></body></body></body></worldbody><actuator> <motor ctrllimited="true" ctrlrange="-1
1" gear="400" joint="slider"/></actuator> </mujoco>""")
add("reacher with a target", "xy plane, limits, armature, unattached slides, ref, "
    "radians, gravity across, welded", 2, """<mujoco><compiler angle="radian"/><default>
<joint armature="1" damping="1" limited="true"/><geom contype="0"/></default><worldbody>
<geom conaffinity="0" size="1 1 10" type="plane"/><geom fromto="-.3 -.3 .01 .3 -.3 .01"
size=".02" type="capsule"/><body name="near" pos="0 0 .01"><geom fromto="0 0 0 .1 0 0"
size=".01" type="capsule"/><joint axis="0 0 1" limited="false"/><body pos="0.1 0 0">
<joint name="elbow" axis="0 0 1" range="-2.9 2.9"/><geom fromto="0 0 0 .12 0 0"
size=".01" type="capsule"/><body name="fingertip" pos="0.13 0 0"><geom
size=".01"/></body></body> </body><body name="target" pos=".1 -.1 .01"><joint
armature="0" axis="1 0 0" damping="0" name="target_x" range="-.3 .3" ref=".1"
type="slide"/><joint armature="0" axis="0 1 0" damping="0" name="target_y" range="-.3
.3" ref="-.1" type="slide"/><geom size=".01"/></body> </worldbody><actuator><motor
ctrlrange="-1 1" ctrllimited="true" gear="150" joint="elbow" /></actuator></mujoco>""")
add("leg in the air", "several joints, negative axis, limits, armature, ref, gear, "
    "degrees, slide", 6, """<mujoco><compiler angle="degree"/><default><joint
armature="1" damping="1" limited="true"/><geom contype="0" density="1000"
type="capsule"/></default> <worldbody><body name="torso" pos="0 0 1.3"><joint
armature="0" axis="1 0 0" damping="0" limited="false" type="slide"/><joint armature="0"
axis="0 0 1" damping="0" limited="false" ref="1.3" type="slide"/><joint armature="0"
axis="0 1 0" damping="0" limited="false"/> <geom fromto="0 0 .2 0 0 -.2"
size=".05"/><body pos="0 0 -.2"><joint name="thigh" axis="0 -1 0" range="-150 20"/><geom
fromto="0 0 0 0 0 -.45" size=".05"/> <body pos="0 0 -.45"><joint name="leg" axis="0 -1
0" range="-150 20"/><geom fromto="0 0 0 0 0 -.5" size=".04"/><body pos="0.06 0 -.6"
quat="0.707 0 -0.707 0"><joint name="foot" axis="0 -1 0" pos="-.1 0 .06" range="-45
45"/><geom size=".06 .19"/></body> </body></body></body></worldbody><actuator><motor
ctrllimited="true" ctrlrange="-1 1" gear="200" joint="thigh"/><motor ctrllimited="true"
ctrlrange="-1 1" gear="-150" joint="leg"/></actuator></mujoco>""")

# In the styles of dm_control

add("cart and pole by classes", "slide, limits, classes, contact disabled, zaxis, "
    "floor", 2, """<mujoco><option timestep="0.01" integrator="RK4"><flag
contact="disable" energy="enable"/></option><default><default class="pole"><joint
axis="0 1 0" damping="2e-6" /><geom type="capsule" fromto="0 0 0 0 0 1" size=".045"
mass=".1"/></default></default> <worldbody><light pos="0 0 6"/><camera name="fixed"
pos="0 -4 1" zaxis="0 -1 0"/> <geom type="plane" pos="0 0 -.05" size="4 4 .2"/><geom
type="capsule" pos="0 .07 1" zaxis="1 0 0" size=".02 2"/><body name="cart" pos="0 0
1"><joint name="slider" type="slide" limited="true" axis="1 0 0" range="-1.8 1.8"
solreflimit=".08 1" damping="5e-4"/> <geom type="box" size=".2 .15 .1" mass="1"/><body
childclass="pole"><joint/><geom/></body> </body></worldbody><actuator><motor
joint="slider" gear="10" ctrllimited="true" ctrlrange="-1 1"/></actuator></mujoco>""")
add("acrobot", "constraints disabled, ornament, tip site, mass", 2, """<mujoco><default>
<joint damping=".05" axis="0 1 0"/><geom type="capsule"
mass="1"/></default><option><flag constraint="disable"/></option><worldbody><geom
size="3 3 .2" type="plane"/><body pos="0 0 2.1"><joint name="shoulder"/><geom
type="cylinder" fromto="0 -.06 0 0 .06 0" size=".05" mass="0"/><geom fromto="0 0 0 0 0
1" size=".05"/><body pos="0 0 1"><joint name="elbow"/><geom fromto="0 0 0 0 0 .9"
size=".05"/><site name="tip" pos="0 0 .9"/></body> </body></worldbody><actuator><motor
joint="elbow" gear="2" ctrllimited="true" ctrlrange="-1 1"/></actuator><sensor><jointpos
joint="elbow"/></sensor></mujoco>""")
add("pendulum with a bob", "mass, contact disabled, damping, one joint", 1, mjcf(
    '<body pos="0 0 .6"><joint name="hinge" axis="0 1 0" damping=".1"/><geom '
    'type="capsule" fromto="0 0 0 0 0 .5" size=".02" mass="0"/><geom pos="0 0 .5" '
    'size=".05" mass="1"/></body>', head='<option><flag contact="disable"/></option>',
    tail='<actuator><motor joint="hinge" ctrlrange="-1 1" '
    'ctrllimited="true"/></actuator>'))
add("finger beside a spinner", "xz plane, negative axis first, limits, ref, degrees, "
    "classes, unattached hinge, gravity disabled, friction beside the arm", 2,
    """<mujoco><option> <flag gravity="disable"
contact="disable"/></option><default><joint axis="0 -1 0"/><default
class="finger"><joint damping="2.5" limited="true"/></default></default><worldbody><body
pos="-.2 0 .4" childclass="finger"><joint name="proximal" range="-110 110" ref="-90"/>
<geom type="capsule" size=".03" fromto="0 0 0 0 0 -.17"/><body pos="0 0 -.18"
childclass="finger"><joint name="distal" range="-110 110"/><geom type="capsule"
size=".03" fromto="0 0 0 0 0 -.16"/></body></body><body pos=".2 0 .4"><joint
name="hinge" frictionloss=".1" damping=".5"/><geom type="capsule" size=".04 .09"
pos=".02 0 0"/><site name="tip" pos="0 0 .13"/></body></worldbody><actuator><motor
joint="proximal" gear="30" ctrllimited="true" ctrlrange="-1 1"/></actuator></mujoco>""")
MASS = ('<body pos="0 0 .01"><joint name="x" type="slide" axis="1 0 0" range="-.3 .3" '
    'damping="1"/><joint name="y" type="slide" axis="0 1 0" damping="2"/><geom '
    'size=".01" mass=".3"/></body>')
add("point mass", "no hinge, limits, xy plane, several joints, gravity across", 2, mjcf(
    MASS, tail='<actuator><motor joint="x" gear=".1"/><motor joint="y" gear=".1" '
    'ctrlrange="-1 1"/></actuator>'))
SLIDE = ('<body pos=".3 0 .1"><joint type="slide" axis="{}" damping="{}"/><geom size='
    '".05"/>{}</body>')
add("slides alone", "slide, no hinge", 4, mjcf(SLIDE.format("1 0 0", 1, SLIDE.format(
    "0 0 1", 2, SLIDE.format("1 0 .7", 3, SLIDE.format("1 0 -2", 4, ""))))))
add("point mass on tendons", "no hinge, limits, dropped tendons, dropped actuators", 2,
    mjcf(MASS, tail='<tendon><fixed name="t"><joint joint="x" coef=".6"/><joint '
    'joint="y" coef=".8"/></fixed></tendon><actuator><motor tendon="t" '
    'gear=".1"/></actuator>'), options=dict(drop=("tendons", "actuators")))

# In the styles of arms with many defaults, of cranes and carriages

add("arm of three classes", "position, forcerange, inertials, key frame, classes, "
    "radians, limits, contacts between no neighbours, dampratio, ee site, ornament", 3,
    """<mujoco> <compiler angle="radian" autolimits="true"/><option
integrator="implicitfast"/><default> <default class="arm"><joint axis="0 1 0"
range="-2.8 2.8" armature=".1" damping=".5"/> <position kp="80" dampratio="1"
forcerange="-60 60" inheritrange="1"/><default class="visual"><geom contype="0"
conaffinity="0" group="2"/></default><default class="small" ><joint armature=".02"
range="-2 2"/><position kp="20" forcerange="-9 9"/></default>
</default></default><worldbody><body name="base" pos="0 0 .3" childclass="arm"><inertial
pos="0 0 0" mass="4" diaginertia=".1 .1 .1"/><geom class="visual" type="cylinder"
size=".1 .1"/><body name="shoulder" pos="0 .1 .1"><inertial mass="3" pos=".01 .08 .14"
quat=".9 .1 .2 .1" diaginertia=".03 .028 .008"/><joint name="lift"/><geom class="visual"
type="box" size=".05 .05 .2" pos="0 0 .2"/><body pos="0 -.1 .4"><inertial mass="2"
pos=".2 .02 0" fullinertia=".01 .04 .045 .002 -.003 .001"/><joint name="bend"/><body
pos=".35 0 0" quat="0 0 1 0"><inertial mass=".5" pos="0 0 .05" diaginertia=".002 .002
.001" /><joint name="wrist" class="small"/><body name="flange" pos="0 .05 .08"><site
name="ee" pos="0 0 .02" quat="-1 1 0
0"/></body></body></body></body></body></worldbody><actuator> <position class="arm"
name="lift" joint="lift"/><position class="arm" joint="bend"/> <position class="small"
joint="wrist"/></actuator><keyframe><key name="home" qpos=".3 -.8 .4" ctrl=".3 -.8
.4"/></keyframe></mujoco>""")
chain = ""
for k in reversed(range(8)):
    sign, turned = (-1) ** (k // 2), f'euler="0 {20 * k} 0"' if k % 3 else ""
    chain = (
        f'<body pos="{0.2 if k else 0} {0.01 * k} 0" {turned}><joint axis="0 {sign} 0" '
        f'damping=".1"/><geom type="capsule" fromto="0 0 0 .2 0 0" size=".02"/>{chain}'
        + ("" if k < 7 else '<site name="tool" pos=".2 0 0"/>')
        + "</body>"
    )
add("eight links", "eight joints, negative axis, tool site, offset along the normal",
    8, mjcf(chain, head='<option><flag contact="disable"/></option>'))
add("telescope", "slide, damping, armature, springref, negative axis, cylinder, "
    "density", 3, mjcf('<body><joint axis="0 -1 0" damping="3"/><geom type="cylinder" '
    'fromto="0 0 0 .5 0 .1" size=".05" density="700"/><body pos=".5 0 .1"><joint '
    'type="slide" axis="1 0 .2" stiffness="200" springref="-.1" damping="4" '
    'armature=".3"/><geom type="box" size=".2 .03 .03"/><body pos=".25 0 0"><joint '
    'axis="0 1 0" stiffness="9" springref="30"/><geom type="ellipsoid" size=".1 .05 '
    '.04" pos=".1 0 0"/></body></body></body>'))
add("gantry", "slide, several bodies with slides, motor, sphere, yz plane", 3, mjcf(
    '<body><joint name="x" type="slide" axis="0 1 0"/><geom type="box" size=".1 .4 .1" '
    'mass="5"/><body pos="0 0 -.3"><joint name="z" type="slide" axis="0 0 -1"/><geom '
    'size=".1" mass="2"/><body pos=".1 0 0"><joint axis="1 0 0"/><geom type="capsule" '
    'fromto="0 0 0 0 0 -.7" size=".01"/><geom size=".06" pos="0 0 '
    '-.7"/></body></body></body>', head='<option><flag contact="disable"/></option>',
    tail='<actuator><motor joint="x" gear="30"/><motor joint="z" gear="-40" '
    'ctrlrange="-2 2" ctrllimited="true"/></actuator>'))
add("crane", "slide, welded, ornament, velocity, position", 3, mjcf('<geom type="box" '
    'size="2 .1 .1" pos="0 .5 2"/><body name="frame" pos="0 0 2"><body name="trolley" '
    'pos=".2 0 0"><joint name="travel" type="slide" axis="-1 0 0"/><geom type="box" '
    'size=".2 .1 .05"/><body name="hook"><joint axis="0 1 0"/><geom type="capsule" '
    'fromto="0 0 0 0 0 -.4" size=".02"/><body name="block" pos="0 0 -.4"><geom '
    'size=".05"/><body name="load" pos=".1 0 -.1"><joint name="hoist" type="slide" '
    'axis="0 0 1"/><geom type="box" size=".1 .1 .1" pos="0 0 -.3" '
    'mass="8"/></body></body></body></body></body>', tail='<actuator><velocity '
    'joint="travel" kv="20"/><position joint="hoist" kp="500" kv="30" ctrlrange="-.2 '
    '.2"/></actuator>'))
add("cart-pole with a rough slide", "slide, friction, limits, radians, key frame", 2,
    cart_pole('<actuator><motor joint="slider" gear="20"/></actuator><keyframe><key '
    'qpos=".2 3.1" qvel="0 .1"/></keyframe>', '<compiler angle="radian"/>',
    'range="-2 2" frictionloss=".3" damping=".1"', 'frictionloss=".01"'))
add("cart-pole without friction and limits", "slide, dropped limits, dropped friction",
    2, cart_pole("", "", 'range="-2 2" frictionloss=".3"'), options=dict(drop=("limits",
    "friction")))

# Planes, directions and units

add("vertical xz", "xz plane, gravity along", 2, arm())
add("upright xy", "xy plane, gravity along", 2, arm(axes=["0 0 1"] * 2, head=
    '<option gravity="1 -9.8 0"/>').replace("0 .1", ".1 0"))
add("sideways yz", "yz plane, oblique gravity", 2, arm(axes=["1 0 0"] * 2, head=
    '<option gravity="3 2 -5"/>').replace(".4 0 .1", "0 .4 .1"))
add("turned by a quaternion", "oblique plane, quat", 2, arm(turn='quat=".8 .3 -.4 .2"'))
add("rounded right angles", "rounding, radians, negative axis", 2, arm(turn=
    'euler="1.5708 0 0"', head='<compiler angle="radian"/>', axes=("0 0 1", "0 1 0"),).
    replace('name="lower" pos', 'name="lower" euler="-1.5708 0 0" pos'), tolerance=1e-5)
add("opposite elbow with everything", "negative axis, limits, springref, motor, key "
    "frame, damping, friction", 2, arm("range='-30 40'", "range='-20 90' stiffness='3' "
    "springref='25' damping='.3' frictionloss='.1'", axes=("0 1 0", "0 -1 0"), tail=
    '<actuator><motor joint="elbow" gear="3" ctrlrange="-1 2"/><position joint="elbow" '
    'kp="20" inheritrange="1"/></actuator><keyframe><key qpos=".1 .4" qvel="1 2" '
    'ctrl=".5 .2"/></keyframe>'))
add("still air", "fluid 0", 2, arm(head='<option density="0" viscosity="0"/>'))
add("thin air", "negligible fluid", 2, arm(head='<option density="1e-9"/>'))
add("dropped air", "dropped fluid", 2,
    arm(head='<option density="1.2" viscosity="2e-5"/>'), options=dict(drop=("fluid",)))

# Joints

add("spring from a reference", "stiffness, ref, springref", 2,
    arm('stiffness="20" springref="-30" ref="10"', 'stiffness="9" ref="15"'))
add("dropped spring", "dropped springs", 2, arm('stiffness="20" damping="1"'),
    options=dict(drop=("springs",)))
add("one-sided ranges", "limits, radians, key frame", 2, arm('range="0 1"',
    'range="-1 0" limited="false"', head='<compiler angle="radian"/>',
    tail='<keyframe><key qpos=".5 2"/></keyframe>'))
add("slides before and after a hinge", "several joints, slide, euler", 4, mjcf('<body '
    'euler="0 20 0"><joint type="slide" axis="1 0 2"/><joint axis="0 -1 0" pos=".1 0 '
    '.1"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".05"/><body pos="0 0 -.5" '
    'euler="0 30 0"><joint axis="0 -1 0" ref="20"/><joint type="slide" axis="1 0 '
    '.2"/><geom type="box" size=".3 .1 .2" pos=".1 0 -.1"/><body pos="0 0 -.2"><geom '
    'size=".1" mass="2"/></body><site name="tip" pos="0 0 -.4"/></body></body>'))
add("hinge before its slides", "several joints, slide, floating base", 4, arm(
    'type="hinge"', 'damping="1"', between='<joint type="slide" axis="1 0 0"/><joint '
    'type="slide" axis="0 0 1" damping="2"/>'))

# Bodies

BODIES = arm()[len("<mujoco><worldbody>"):-len("</worldbody></mujoco>")]
add("on a mocap body", "mocap marker, key frame", 2, mjcf(
    f'<body mocap="true">{BODIES}</body>', tail='<keyframe><key mpos="0 0 1" '
    'mquat=".9 0 .4 0" qpos=".1 .2"/></keyframe>'))
BALL = '<body pos="0 0 3"><freejoint/><geom size=".1"/></body>'
add("ball beside", "unattached free joint", 2, arm(world=BALL))
add("ornaments", "ornament, mocap marker, welded, hand site", 2, arm(world='<body '
    'mocap="true" pos="1 0 1"><geom size=".02" contype="0" '
    'conaffinity="0"/></body><body pos="0 1 0"><geom size=".1"/></body>', last='<body '
    'pos=".1 .05 0" euler="0 0 30"><geom type="box" size=".05 .06 .07"/></body><body '
    'pos=".3 0 0"><body><site name="hand"/></body></body>'))
add("tip of another name", "tip by name", 2, arm(last='<site name="tip"/><site '
    'name="pen" pos=".3 0 -.1"/>'), options=dict(tip="pen"))
add("touching by intention", "dropped contacts, contacts at the start", 2, arm(
    world='<geom type="plane" size="9 9 .1"/>', turn='pos="0 0 .02"'),
    options=dict(drop=("contacts",)))
add("dropped equality", "dropped equalities", 2, arm(tail='<equality><joint joint1='
    '"shoulder" joint2="elbow"/></equality>'), options=dict(drop=("equalities",)))

# Actuators and tendons


def actuated(name, features, *actuators, joints="", tail="", **rest):
    inside = "".join(f"<{actuator}/>" for actuator in actuators)
    tail = f"<actuator>{inside}</actuator>{tail}"
    text = arm(joints, joints, axes=("0 1 0", "0 -1 0"), tail=tail)
    add(name, features, 2, text, **rest)


FIRST, SECOND = 'joint="shoulder"', 'joint="elbow"'
actuated("stiffnesses that cancel", "position", f'position {FIRST} kp="5"', f'position '
    f'{FIRST} kp="-5"', f'position {SECOND} kp="0"')
actuated("motors with limits", "motor, forcerange, ctrlrange, gear", f'motor {FIRST} '
    f'gear=' '"30" ctrlrange="-1 1" forcerange="-.5 .3"', f'motor {SECOND} gear="-2.5"')
actuated("limited joints", "motor, actuatorfrcrange, position", f'motor {FIRST} '
    f'gear="9"', f'position {FIRST} kp="20" kv="1"', f'position {SECOND} kp="30" '
    f'forcerange="-4 4"', joints='actuatorfrcrange="-3 2"')
actuated("lagging positions", "position, timeconst, dampratio, stateful", f'position '
    f'{FIRST} ' 'kp="40" kv="2" timeconst=".1"', f'position {SECOND} kp="30" '
    f'dampratio=".7" timeconst=' '".05" gear="2"', joints='armature=".1"')
actuated("velocities", "velocity, forcerange", f'velocity {FIRST} kv="5" ctrlrange="-2 '
    f'2"', f'velocity {SECOND} kv="3" gear="-2" forcerange="-4 4"')
actuated("controlled dampers", "damper, ctrlrange", f'damper {FIRST} kv="3" '
    'ctrlrange="0 1"', f'damper {SECOND} kv="2" ctrlrange="0 5" gear="2"')
actuated("integrated velocities", "intvelocity, actrange, stateful", f'intvelocity '
    f'{FIRST} ' 'kp="30" kv="1" actrange="-1 .7"', f'intvelocity {SECOND} kp="9" '
    f'actrange="-.2 .2"')
actuated("state in a key frame", "stateful, key frame, timeconst, act", f'position '
    f'{FIRST} ' 'kp="40" timeconst=".2"', tail='<keyframe><key qpos=".1 .2" act=".3" '
    'ctrl="-.4"/></keyframe>')
actuated("general", "affine, filter, stateful, gain by position", f'general {FIRST} '
    f'gainprm=' '"3" biastype="affine" biasprm="1 -3 -1" dyntype="filter" dynprm=".1"',
    f'general {SECOND} gaintype="affine" gainprm="3 1 -.5" ctrlrange="0 2"')
actuated("mixed", "motor, position, velocity, damper, gear", f'motor {SECOND} '
    f'gear=".5"', f'position {FIRST} kp="9" gear="-2"', f'velocity {SECOND} kv="1"',
    f'damper {SECOND} ' 'kv="1" ctrlrange="0 1"', joints='damping=".1" stiffness="2" '
    'armature=".05"')
actuated("pid", "pid, two controls", f'pid {FIRST} kp="30" kv="2"', f'pid {SECOND} '
    f'kp="9" ' 'kv="1" input="pos"')
actuated("pid with an integral", "pid, stateful", f'pid {FIRST} kp="30" kv="2" ki="5" '
    'imax=".3"', f'pid {SECOND} kp="9" ki="3" kv="1" input="pos"')
actuated("dc motors", "dcmotor, gear", f'dcmotor {FIRST} motorconst=".05" '
    f'resistance="2" ' 'gear="100"', f'dcmotor {SECOND} motorconst=".1" resistance="4" '
    f'gear="-20"')
actuated("dc motors with currents", "dcmotor, stateful, transmission damping",
    f'dcmotor {FIRST} motorconst=".05" resistance="2" inductance=".02" gear="100" '
    f'damping="1e-4" ' 'armature="1e-5"', f'motor {SECOND} damping=".2" armature=".1" '
    f'gear="2"')
actuated("dropped actuators", "dropped actuators", f'motor {FIRST}',
    options=dict(drop=("actuators",)))


def tied(name, features, attributes, to="anchor"):
    text = arm(world='<site name="anchor" pos=".2 .1 1"/>', between='<site name="mid" '
        'pos=".2 .1 .1"/>', last='<site name="far" pos=".25 .1 .05"/>', tail='<tendon>'
        f'<spatial name="t" {attributes}><site site="{to}"/><site site="far"/>'
        '</spatial></tendon>')
    add(name, features, 2, text)


tied("spring in the air", "tendon stiffness, springlength", 'stiffness="50" '
    'springlength=".3"')
tied("cable", "tendon stiffness, one-sided spring", 'stiffness="50" springlength="0 '
    '.6"')
tied("bumper", "tendon stiffness, one-sided spring", 'stiffness="50" springlength=".5 '
    '9"')
PAIR = '<body pos="0 {} 0"><joint name="{}" axis="0 1 0"/><geom size=".1"/></body>'
add("tied beside", "unattached hinges, tendon beside, equality beside", 2, arm(
    axes=("0 1 0", "0 1 0"), world=PAIR.format(2, "u") + PAIR.format(4, "v"),
    tail='<tendon><fixed name="t" limited="true" range="-1 1"><joint joint="u" '
    'coef="1"/><joint joint="v" coef="1"/></fixed></tendon><equality><joint joint1="u" '
    'joint2="v"/></equality>'))
add("dropped tendon", "tendon, dropped tendon", 2, arm(
    world='<site name="anchor"/>', last='<site name="far"/>', tail='<tendon><spatial '
    'limited="true" range="0 9" frictionloss="1" stiffness="4"><site site="anchor"/>'
    '<site site="far"/></spatial></tendon>'), options=dict(drop=("tendons",)))
tied("slack spring", "tendon stiffness, dead band", 'stiffness="50" springlength=".4 '
    '.6"')
tied("spring from its first length", "tendon stiffness, springlength -1",
    'stiffness="40"')
tied("strut between links", "tendon stiffness, tendon damping",
    'stiffness="30" damping="4" springlength=".2"', to="mid")

# From files

POLE = ('<mujocoinclude><body name="pole"><joint axis="0 1 0"/><geom type="capsule" '
    'fromto="0 0 0 0 0 .6" size=".04"/></body></mujocoinclude>')
add("included pole", "include", 2, mjcf('<body><joint type="slide" axis="1 0 0"/><geom '
    'size=".1"/><include file="pole.xml"/></body>'), files={"pole.xml": POLE})
add("link from a mesh", "mesh", 2, arm(head='<asset><mesh name="m" file="box.stl" '
    'scale="1 1 2"/><mesh file="wedge.obj"/></asset>', last='<geom type="mesh" '
    'mesh="m" density="300" contype="0" conaffinity="0"/>', between='<geom type="mesh" '
    'mesh="wedge" mass="0" contype="0" conaffinity="0"/>'), files={"box.stl": box_stl(
    .3, .05, .1), "wedge.obj": WEDGE_OBJ})

# URDF


def link(name, mass=1.0, at=".2 0 .05", visual=""):
    return (
        f'<link name="{name}"><inertial><origin xyz="{at}" rpy=".1 0 .2"/>'
        f'<mass value="{mass}"/><inertia ixx=".02" iyy=".03" izz=".04" ixy=".002" '
        f'ixz="0" iyz="-.001"/></inertial>{visual}</link>'
    )


def joint(kind, parent, child, at="0 0 0", axis="0 1 0", inside=""):
    axis = f'<axis xyz="{axis}"/>' if axis else ""
    limit = '<limit lower="-1" upper="1.2" effort="50" velocity="3"/>'
    inside += limit if kind != "fixed" else ""
    return (
        f'<joint name="{parent}-{child}" type="{kind}"><parent link="{parent}"/>'
        f'<child link="{child}"/><origin xyz="{at}"/>{axis}{inside}</joint>'
    )


def robot(*parts):
    return '<?xml version="1.0"?><robot name="arm">' + "".join(parts) + "</robot>"


BASE = '<link name="base"/>'
ELBOW = joint("revolute", "a", "b", ".4 0 .1", "0 -1 0", '<dynamics damping=".2" '
    'friction=".1"/>')
WORLD = '<link name="world"/>' + joint("fixed", "world", "base", "0 0 1", "")
PART = (link("a"), link("b", 0.5), joint("revolute", "base", "a"), ELBOW)
GEAR = ('<transmission name="t"><type>transmission_interface/SimpleTransmission</type>'
    '<joint name="a-b"/><actuator name="m"><mechanicalReduction>50'
    '</mechanicalReduction></actuator></transmission><gazebo reference="a"/>')
SHAPE = ('<collision><origin xyz=".1 0 0" rpy="0 1.5708 0"/><geometry><cylinder '
    'radius=".02" length=".2"/></geometry></collision>')
MESH = '<visual><geometry><mesh filename="package://arm/{}"/></geometry></visual>'
URDF = "urdf, limits, friction, effort limit"
add("urdf", f"{URDF}, negative axis", 2, robot(BASE, *PART))
add("urdf with a world", f"{URDF}, world link, transmission", 2,
    robot(WORLD, link("base"), *PART, GEAR))
add("urdf of turning joints", f"{URDF}, continuous, fixed, x axis by default", 3, robot(
    BASE, *(link(name, visual=SHAPE) for name in "abcd"),
    joint("continuous", "base", "a", axis=None), joint("fixed", "a", "b", ".1 0 0"),
    joint("continuous", "b", "c", "0 .1 .3", "1 0 0"), joint("revolute", "c", "d",
    "0 .3 0", "-1 0 0", '<dynamics friction=".1"/>')))
add("urdf sliders", "urdf, prismatic, no hinge, limits, effort limit", 2, robot(
    BASE, link("a"), link("b"), joint("prismatic", "base", "a", axis="1 0 0"),
    joint("prismatic", "a", "b", axis="0 0 1")))
add("urdf cart-pole", "urdf, prismatic, continuous, limits, effort limit", 2, robot(
    BASE, link("cart", at="0 0 0"), link("pole", 0.2), joint("prismatic", "base", ""
    "cart", axis="1 0 0"), joint("continuous", "cart", "pole")))
add("urdf without its pictures", f"{URDF}, missing mesh, rounding", 3, robot(
    BASE, link("a", visual=MESH.format("a.dae") + SHAPE), *PART[1:], link("c"), joint(
    "revolute", "b", "c", '.3 0 0" rpy="1.5708 0 0', "0 0 1")), tolerance=1e-5)
add("urdf with a mesh", f"{URDF}, mesh", 2, robot(BASE, link("a", visual='<collision>'
    '<geometry><mesh filename="box.stl"/></geometry></collision>'), *PART[1:]),
    files={"box.stl": box_stl(.3, .05, .1)})

# Refused

REFUSED: dict[str, tuple[str, str]] = {}  # a pattern of the message, and the model


def refuse(name, words, text):
    REFUSED[name] = words, text


def nested(count, inside=""):
    body = '<body pos=".1 0 0"><joint axis="0 1 0"/><geom size=".03" contype="0"/>'
    return mjcf(count * body + inside + count * "</body>")


LEAF = '<body pos="0 0 .2"><joint axis="0 1 0"/><geom size=".03" contype="0"/></body>'
NEITHER = "neither a hinge nor a slide"
refuse("nine joints", "1 to 8 letters", nested(9))
refuse("ball joint", NEITHER, nested(1, LEAF.replace('axis="0 1 0"',
    'type="ball"')))
refuse("free base", NEITHER, mjcf(
    f'<body><freejoint/><geom size=".1"/>{LEAF}</body>'))
refuse("branches", "branches: bodies .* both follow", nested(1, LEAF + LEAF))
refuse("loop", "a loop or another constraint", arm(
    tail='<equality><connect body1="lower" anchor=".3 0 0"/></equality>'))
refuse("pulled tendon", "a transmission .tendon. beyond",
    arm(world='<site name="p" pos="0 0 1"/>', between=
    '<site name="q" pos=".2 0 .2"/>', last='<site name="r" pos=".2 0 0"/>', tail=
    '<tendon><spatial name="t"><site site="p"/><site site="q"/><site site="r"/>'
    '</spatial></tendon><actuator><motor tendon="t"/></actuator>'))
refuse("tendon to a body beside", "tendon .* with ",
    arm(world='<body pos="1 0 0"><joint '
    'type="slide" axis="1 0 0"/><geom size=".1"/><site name="b"/></body>', last=
    '<site name="a"/>', tail='<tendon><spatial stiffness="9"><site site="a"/>'
    '<site site="b"/></spatial></tendon>'))
refuse("muscle", "muscle", arm(
    tail='<actuator><muscle joint="elbow" lengthrange="-1 1"/></actuator>'))
refuse("file of the machine", "names no other files", arm(
    world='<include file="/etc/hostname"/>'))
refuse("mesh of the machine", "names no other files", arm(
    head='<asset><mesh file="/tmp/part.stl"/></asset>'))
refuse("tilted hinge", "the axis of joint elbow along",
    arm(axes=("0 1 0", "0 .995 .0998")))
refuse("limited gear", "limit of actuator forces", arm(tail='<tendon><fixed name="t" '
    'actuatorfrclimited="true" actuatorfrcrange="-1 1"><joint joint="elbow" coef="1"/>'
    '</fixed></tendon><actuator><motor tendon="t"/></actuator>'))
refuse("nothing but a marker", "without joints", mjcf(
    '<body mocap="true"><geom size=".1"/></body>'))
refuse("endless gravity", "finite gravity", arm(head='<option gravity="0 0 nan"/>'))
refuse("start that is no number", "a finite start", arm(
    tail='<keyframe><key qpos="nan 0"/></keyframe>'))
refuse("another document", "in XML without entities", '<!DOCTYPE mujoco ['
    '<!ENTITY a "><mujoco><include file=\'/etc/hostname\'/></mujoco><!--"> ]>'
    "<mujoco/><!-- -->")
refuse("deep robot", "nested too deep", "<robot>" + 20000 * "<mujoco>" +
    20000 * "</mujoco>" + "</robot>")
refuse("slide across", "the axis of joint elbow in the plane",
    arm(second='type="slide"'))
refuse("contact at the start", "with a contact", arm(
    world='<geom type="plane" size="9 9 .1"/>', turn='pos="0 0 .02"'))
refuse("plugin", "with a plugin", arm(
    head='<extension><plugin plugin="mujoco.pid"><instance name="p"><config key="kp" '
    'value="4"/></instance></plugin></extension>', tail='<actuator><plugin '
    'joint="elbow" plugin="mujoco.pid" instance="p"/></actuator>'))
if NEWER:
    refuse("slew rate", "slew rate", arm(
        tail='<actuator><pid joint="elbow" kp="3" slewmax="2"/></actuator>'))
refuse("water", "a fluid of density 1000", arm(
    head='<option density="1000" viscosity=".001"/>'))

# fmt: on
