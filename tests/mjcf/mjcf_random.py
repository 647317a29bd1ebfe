"""Random models of planar chains for `from_mjcf`, with random features."""

import numpy as np
from mjcf_texts import NEWER

KINDS = [
    "motor",
    "position",
    "position",
    "velocity",
    "damper",
    "intvelocity",
    "general",
]
KINDS += ["pid", "dcmotor"] * NEWER
SHAPES = "capsule box sphere cylinder ellipsoid".split()
BODIES = "h h h h s hs sh hh ss ssh hss".split()  # joints in a body


def random_text(rng):
    """Returns a random planar chain of 1 to 8 joints, and its features.

    Its plane has any direction. Ranges are wide: 2.5 rad or 1.5 m to each side.
    """
    features: set[str] = set()

    def has(feature, chance):
        if rng.random() < chance:
            features.add(feature)
            return True
        return False

    text = lambda *values: " ".join(f"{value:.5f}" for value in values)
    uniform = lambda *ends: text(rng.uniform(*ends))
    count, degrees = int(rng.integers(1, 9)), has("degrees", 0.5)
    turn = lambda *angles: text(*np.multiply(angles, 180 / np.pi if degrees else 1))
    kinds, qpos, sites, actuators, tendons = "", [], [], [], []

    def joint(kind, turned, at):
        name, hinge = f"j{len(kinds)}", kind == "h"
        size = turn if hinge else text
        sign = -1 if hinge and has("negative axis", 0.4) else 1
        own = f'<joint name="{name}" axis="0 {sign} 0" pos="{text(*at)}"'
        if not hinge:
            features.add("slide")
            axis = text(np.cos(turned), 0, np.sin(turned))
            own = f'<joint name="{name}" type="slide" axis="{axis}"'
        ref = rng.normal(0, 0.3) if has("ref", 0.2) else 0.0
        qpos.append(ref)
        own += f' ref="{size(ref)}"'
        if has("limits", 0.3):
            low, high = rng.uniform(2.5, 3, size=2) if hinge else rng.uniform(1.5, 2, 2)
            own += f' range="{size(ref - low, ref + high)}"'
        for attribute, chance, least, most in (
            ("damping", 0.4, 0.05, 2),
            ("armature", 0.3, 0.01, 0.2),
            ("stiffness", 0.3, 1, 30),
            ("frictionloss", 0.15, 0.01, 1),
        ):
            if has(attribute.replace("loss", ""), chance):
                own += f' {attribute}="{uniform(least, most)}"'
        if has("springref", 0.2):
            own += f' springref="{size(rng.normal(0, 0.5))}"'
        if has("actuatorfrcrange", 0.15):
            own += f' actuatorfrcrange="{text(*rng.uniform([-9, 0], [0, 9]))}"'
        return own + "/>"

    def solid():
        direction = lambda: f'quat="{text(*rng.normal(size=4))}"'
        at = f'pos="{text(*rng.normal(0, 0.2, size=3))}" {direction()}'
        if has("inertial", 0.3):
            a, b, c = rng.uniform(0.01, 0.1, size=3)
            inertia = f'diaginertia="{text(b + c, a + c, a + b)}"'
            if has("fullinertia", 0.4):
                at, points = at[: at.index("quat")], rng.normal(0, 0.2, size=(3, 4))
                full = np.sum(points**2) * np.eye(3) - points @ points.T
                entries = full[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
                inertia = f'fullinertia="{text(*entries)}"'
            return f'<inertial {at} mass="{uniform(0.5, 3)}" {inertia}/>'
        kind = str(rng.choice(SHAPES))
        features.add(kind)
        weight = ("mass", 0.5, 3) if has("mass", 0.4) else ("density", 300, 3000)
        own = f'type="{kind}" {weight[0]}="{uniform(*weight[1:])}"'
        return f'<geom {own} size="{text(*rng.uniform(0.05, 0.2, size=3))}" {at}/>'

    chain, closing, depth = "", "", 0.0  # how far along the normal the body is
    while len(kinds) < count:
        own = str(rng.choice(BODIES))[: count - len(kinds)]
        if not kinds and "h" not in own and not (own == "ss" and has("no hinge", 0.3)):
            own = "h"
        x, y, z = rng.normal(0, [0.4, 0.05, 0.4]).round(5)
        depth += y
        chain += f'<body pos="{text(x, y, z)}" euler="{turn(0, rng.normal(), 0)}">'
        if len(own) > 1:
            features.add("several joints")
        turned, at = rng.uniform(0, 6), np.zeros(3)
        for kind in own:
            chain += joint(kind, turned, at)
            kinds += kind
            turned, at = turned + rng.uniform(0.8, 2.3), np.array([0.2, 0.1, 0.2])
        chain += solid()
        sites.append(f"s{len(sites)}")
        x, z = rng.normal(0, 0.3, size=2)
        chain += f'<site name="{sites[-1]}" pos="{text(x, -depth, z)}"/>'
        closing += "</body>"
        if has("welded", 0.2):
            chain += (
                f'<body pos=".1 0 -.1" euler="{turn(0.2, 1, -0.3)}">{solid()}</body>'
            )
        if has("welded between", 0.15):
            chain += f'<body pos=".1 0 .1" euler="{turn(0, -1, 0)}">{solid()}'
            closing += "</body>"
    if has("tip site", 0.4):
        chain += '<site name="tip" pos=".3 0 .2"/>'

    if "h" in kinds:
        features.discard("no hinge")
    spread = lambda *ends: f'"{text(*rng.uniform(*ends))}"'
    for name in (f"j{k}" for k in range(count) if rng.random() < 0.5):
        kind = str(rng.choice(KINDS))
        features.add(kind)
        own = f'<{kind} joint="{name}" gear={spread([-3], [3])}'
        if kind == "damper":
            own += f' kv={spread([0.1], [3])} ctrlrange="0 {uniform(0.5, 2)}"'
        elif kind == "dcmotor":
            own += f" motorconst={spread([0.05], [1])} resistance={spread([0.5], [4])}"
            if has("inductance", 0.4):
                own += ' inductance=".05"'
        elif kind == "general":
            bias = spread([-1, -9, -3], [1, 0, 0])
            own += f' gainprm={spread([-5], [5])} biastype="affine" biasprm={bias}'
            own += ' dyntype="filter" dynprm=".2"' * has("filter", 0.4)
        elif kind == "velocity":
            own += f" kv={spread([0.1], [5])}"
        elif kind != "motor":
            damped = kind != "pid" and has("dampratio", 0.3)
            own += f" kp={spread([1], [50])}"
            own += (
                f" dampratio={spread([0.3], [2])}"
                if damped
                else f" kv={spread([0], [3])}"
            )
            if kind == "position" and has("timeconst", 0.3):
                own += f" timeconst={spread([0.02], [0.3])}"
            if kind == "intvelocity":
                own += f" actrange={spread([-2, 0.2], [-0.2, 2])}"
            if kind == "pid" and has("integral", 0.5):
                own += f" ki={spread([0.5], [9])} imax={spread([0.2], [2])}"
        if kind not in ("damper", "pid") and has("ctrlrange", 0.4):
            own += f" ctrlrange={spread([-2, 0.2], [-0.2, 2])}"
        if kind != "dcmotor" and has("forcerange", 0.2):
            own += f" forcerange={spread([-6, 0.2], [-0.2, 6])}"
        actuators.append(own + "/>")
    for k in range(2):
        if has("tendon", 0.2):
            own = f"<spatial stiffness={spread([1], [40])}"
            if has("tendon damping", 0.4):
                own += f" damping={spread([0.1], [3])}"
            if has("springlength", 0.7):
                rest = [[0.3], [0, 0.6], [0.4, 9], [0.3, 0.8]][rng.integers(4)]
                own += f' springlength="{text(*rest)}"'
            first = "anchor" if k == 0 or len(sites) < 2 else sites[0]
            own += f'><site site="{first}"/><site site="{sites[-1]}"/></spatial>'
            tendons.append(own)
    beside = ""
    if has("mocap marker", 0.1):
        beside += '<body mocap="true"><geom size=".02"/></body>'
    rest = []  # of the bodies beside the arm
    if has("ball beside", 0.1):
        beside += '<body pos="3 3 3"><freejoint/><geom size=".1"/></body>'
        rest = [3, 3, 3, 1, 0, 0, 0]
    keys = ""
    if has("key frame", 0.3):
        place = text(*qpos + rng.normal(0, 0.3, size=count), *rest)
        speed = text(*rng.normal(size=count + len(rest) * 6 // 7))
        keys = f'<keyframe><key qpos="{place}" qvel="{speed}"/></keyframe>'
    gravity = text(*rng.normal(0, 6, size=3))
    flag = ' gravity="disable"' * has("gravity disabled", 0.1)
    parts = (
        f'<compiler angle="{"degree" if degrees else "radian"}"/>',
        f'<option gravity="{gravity}"><flag contact="disable"{flag}/></option>',
        f'<worldbody><body quat="{text(*rng.normal(size=4))}">',
        f'<site name="anchor" pos=".4 0 -.5"/>{chain}{closing}</body>{beside}',
        f"</worldbody><tendon>{''.join(tendons)}</tendon>",
        f"<actuator>{''.join(actuators)}</actuator>{keys}",
    )
    return f"<mujoco>{''.join(parts)}</mujoco>", tuple(sorted(features))
