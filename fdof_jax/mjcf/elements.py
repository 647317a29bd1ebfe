"""Force elements of a MuJoCo model: those of its joints and its tendons."""

from typing import Any

import numpy as np

from .. import Element, JointDamper, Point, SpringDamper
from ..forces import Armature, JointFriction, JointSpring, JointStops
from .actuators import inertias_of_actuators
from .chain import FAR, Chain, Reader

# A stop of MuJoCo is close to plastic; this damping [s/m or s/rad] returns a tenth of
# the speed of 1 m/s or 1 rad/s.
_STOP_DAMPING = 10.0


def elements_in_joints(read: Reader, chain: Chain) -> list[Element]:
    """Dampers, armatures, springs, stops and friction of the joints."""
    model, joints, rates = read.model, chain.joints, chain.rates
    for name, joint, rate in zip(chain.names, joints, rates):
        for array, index, kind, what in (
            ("jnt_stiffnesspoly", joint, "springs", "a nonlinear spring"),
            ("jnt_springyield", joint, "springs", "a spring that yields"),
            ("dof_dampingpoly", rate, "damping", "nonlinear damping"),
        ):
            if read.has(array, index):
                read.leave(kind, f"joint {name}", what)
    forces: list[Element] = []

    def add(kind: str, flags: str, element: type, *values: np.ndarray) -> None:
        """Adds an element with values, unless all are 0, switched off or dropped."""
        words = "left out, as asked" if kind in read.drop else element.__name__
        if words == "JointFriction":
            words += ", which holds still where MuJoCo's creeps"
        there = () if read.disabled(*flags.split()) else np.flatnonzero(values[0])
        for k in there:
            read.note(f"joint {chain.names[k]}", f"{kind} {values[0][k]:.4g}: {words}")
        if len(there) and kind not in read.drop:
            forces.append(element(*values))

    damping = np.array(model.dof_damping[rates])
    armature = np.array(model.dof_armature[rates])
    for gears, own_damping, own_armature in inertias_of_actuators(read, chain):
        damping += gears**2 * own_damping
        armature += gears**2 * own_armature
    add("damping", "PASSIVE DAMPER", JointDamper, damping)
    add("armature", "", Armature, armature)
    rest = chain.signs * model.qpos_spring[chain.places]
    add("springs", "PASSIVE SPRING", JointSpring, model.jnt_stiffness[joints], rest)
    friction = model.dof_frictionloss[rates]
    add("friction", "FRICTIONLOSS CONSTRAINT", JointFriction, friction)
    limited = model.jnt_limited[joints].astype(bool)
    if limited.any() and not read.disabled("LIMIT", "CONSTRAINT"):
        forces += _stops(read, chain, limited)
    return forces


def _stops(read: Reader, chain: Chain, limited: np.ndarray) -> list[Element]:
    """Stops in the place of ranges, as stiff as MuJoCo's constraints are at qpos0."""
    model, dropped = read.model, "limits" in read.drop
    low, high = read.bounds("jnt_", chain.joints, chain.signs)
    # MuJoCo's constraint acts from the margin within the range on.
    margin = model.jnt_margin[chain.joints]
    lower, upper = low + margin, high - margin
    stiffness = np.ones(len(limited))
    for k, joint in enumerate(chain.joints):
        # What a constraint with the reference (time, damping ratio), or (-stiffness,
        # -damping), gives way under a steady load, at its greatest impedance.
        time, ratio = model.jnt_solref[joint]
        if limited[k] and time >= 0 and not ratio > 0:
            read.leave("limits", f"joint {chain.names[k]}", "a damping ratio of 0")
            return []
        if time >= 0 and not read.disabled("REFSAFE"):
            time = max(time, 2 * model.opt.timestep)
        impedance = min(max(model.jnt_solimp[joint, 1], 1e-4), 1 - 1e-4)
        rate = -time if time < 0 else 1 / max(time * ratio, 1e-9) ** 2
        mass = 1 / max(float(model.dof_invweight0[chain.rates[k]]), 1e-15)
        stiffness[k] = max(mass * rate / (1 - impedance), 1e-9)
        if limited[k]:
            words = "left out, as asked"
            if not dropped:
                words = f"JointStops of {stiffness[k]:.3g} N/m or N m/rad, about as "
                words += "stiff as MuJoCo's soft constraint"
            ends = f"range {lower[k]:.4g} to {upper[k]:.4g}"
            read.note(f"joint {chain.names[k]}", f"{ends}: {words}")
    if dropped:
        return []
    return [JointStops(lower, upper, stiffness=stiffness, damping=_STOP_DAMPING)]


def springs_of_tendons(read: Reader, chain: Chain) -> list[Element]:
    """Springs and dampers between two sites."""
    model, forces = read.model, []
    no_limits = read.disabled("LIMIT", "CONSTRAINT")
    for tendon in range(model.ntendon):
        name = f"tendon {read.name_of('tendon', tendon)}"
        if not (chain.links[_bodies_of(read, tendon)] > 0).any():
            read.note(name, "left out, beside the arm")
            continue
        if "tendons" in read.drop:
            read.note(name, "left out, as asked")
            continue
        for array, kind, what in (
            ("tendon_limited", "limits", "a range"),
            ("tendon_actfrclimited", "tendons", "a limit of actuator forces"),
            ("tendon_frictionloss", "friction", "friction"),
            ("tendon_armature", "tendons", "an armature"),
            ("tendon_stiffnesspoly", "tendons", "a nonlinear spring"),
            ("tendon_springyield", "tendons", "a spring that yields"),
            ("tendon_dampingpoly", "tendons", "nonlinear damping"),
        ):
            off = kind == "limits" and no_limits
            if read.has(array, tendon) and not off:
                read.leave(kind, name, what)
        stiffness = damping = 0.0
        if not read.disabled("PASSIVE", "SPRING"):
            stiffness = float(model.tendon_stiffness[tendon])
        if not read.disabled("PASSIVE", "DAMPER"):
            damping = float(model.tendon_damping[tendon])
        if not stiffness and not damping:
            continue
        if points := _ends(read, chain, tendon):
            low, high = map(float, model.tendon_lengthspring[tendon])
            forces += _springs(points, stiffness, damping, low, high)
            read.note(name, "SpringDamper")
        else:
            read.leave("tendons", name, "a spring that is not between two sites of it")
    return forces


def _springs(
    points: tuple[Point, Point], k: float, damping: float, low: float, high: float
) -> list[SpringDamper]:
    """Springs that are slack between two lengths; the damper always acts."""
    if low == high:
        keywords: Any = dict(stiffness=k, damping=damping, rest_length=low)
        return [SpringDamper(*points, **keywords)]
    springs = [SpringDamper(*points, damping=damping)] if damping else []
    for side, length, there in (("bumper", low, low > 0), ("cable", high, high < FAR)):
        if there and k:
            keywords = dict(stiffness=k, rest_length=length, one_sided=side)
            springs.append(SpringDamper(*points, **keywords))
    return springs


def _bodies_of(read: Reader, tendon: int) -> list[int]:
    """The bodies on which a tendon acts."""
    model, kinds = read.model, read.mujoco.mjtWrap
    owners = {
        int(kinds.mjWRAP_JOINT): model.jnt_bodyid,
        int(kinds.mjWRAP_SITE): model.site_bodyid,
        int(kinds.mjWRAP_SPHERE): model.geom_bodyid,
        int(kinds.mjWRAP_CYLINDER): model.geom_bodyid,
    }
    path = read.path_of_tendon(tendon)
    return [
        int(owners[int(kind)][thing])
        for kind, thing in zip(model.wrap_type[path], model.wrap_objid[path])
        if int(kind) in owners
    ]


def _ends(read: Reader, chain: Chain, tendon: int) -> tuple[Point, Point] | None:
    """The points of a tendon between two sites of the arm, in its plane."""
    model, wraps = read.model, read.path_of_tendon(tendon)
    sites, kinds = model.wrap_objid[wraps], model.wrap_type[wraps]
    if len(sites) != 2 or (kinds != int(read.mujoco.mjtWrap.mjWRAP_SITE)).any():
        return None
    links = chain.links[model.site_bodyid[sites]]
    data = read.data_at_start()
    data.qpos[chain.places] = 0
    read.mujoco.mj_kinematics(model, data)
    places = data.site_xpos[sites]
    if (links < 0).any() or abs((places[1] - places[0]) @ chain.normal) > 1e-9:
        return None
    local = np.array([*map(chain.plane, places)]) - chain.starts[links]
    local *= np.exp(-1j * chain.turns[links])
    a, b = (Point(int(link), p.real, p.imag) for link, p in zip(links, local))
    return a, b
