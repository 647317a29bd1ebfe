"""Force elements of a MuJoCo model: those of its joints and tendons."""

from typing import Any

import numpy as np

from .. import Element, JointDamper, Point, SpringDamper
from ..forces import Armature, JointFriction, JointSpring, JointStops
from .actuators import inertias_of_actuators, sum_of
from .chain import FAR, Chain, Reader
from .law import Actuators

# A stop of MuJoCo is close to plastic; this damping [s/m or s/rad] returns a tenth of
# the speed of 1 m/s or 1 rad/s.
_STOP_DAMPING = 10.0
_RANGE = "a range, which joints alone have here (a stiff cable or bumper is near it)"


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
        """Adds an element, unless its values are 0, switched off or dropped."""
        words = "left out, as asked" if kind in read.drop else element.__name__
        if words == "JointFriction":
            words += ", which holds still where MuJoCo's creeps"
        there = () if read.disabled(*flags.split()) else np.flatnonzero(values[0])
        for k in there:
            read.note(f"joint {chain.names[k]}", f"{kind} {values[0][k]:.4g}: {words}")
        if len(there) and kind not in read.drop:
            forces.append(element(*values))

    damping, armature = inertias_of_actuators(read, chain)
    add("damping", "PASSIVE DAMPER", JointDamper, damping + model.dof_damping[rates])
    add("armature", "", Armature, armature + model.dof_armature[rates])
    rest = chain.signs * model.qpos_spring[chain.places]
    add("springs", "PASSIVE SPRING", JointSpring, model.jnt_stiffness[joints], rest)
    friction = model.dof_frictionloss[rates]
    add("friction", "FRICTIONLOSS CONSTRAINT", JointFriction, friction)
    limited = model.jnt_limited[joints].astype(bool)
    if limited.any() and not read.disabled("LIMIT", "CONSTRAINT"):
        forces += _stops(read, chain, limited)
    return forces


def _stops(read: Reader, chain: Chain, limited: np.ndarray) -> list[Element]:
    """Stops in place of ranges, as stiff as MuJoCo's constraints at qpos0."""
    model, dropped = read.model, "limits" in read.drop
    # MuJoCo's constraint acts from the margin within the range on.
    within = np.outer((1, -1), model.jnt_margin[chain.joints])
    lower, upper = within + read.bounds("jnt_", chain.joints, chain.signs)
    # What a constraint with the reference (time, damping ratio), or (-stiffness,
    # -damping), gives way under a steady load, at its greatest impedance.
    time, ratio = model.jnt_solref[chain.joints].T
    least = 0.0 if read.disabled("REFSAFE") else 2 * model.opt.timestep
    lag = np.maximum(np.maximum(time, least) * ratio, 1e-9)
    impedance = np.clip(model.jnt_solimp[chain.joints, 1], 1e-4, 1 - 1e-4)
    mass = 1 / np.maximum(model.dof_invweight0[chain.rates], 1e-15)
    stiffness = mass * np.where(time < 0, -time, lag**-2) / (1 - impedance)
    stiffness = np.where(limited, np.maximum(stiffness, 1e-9), 1)
    for k in np.flatnonzero(limited):
        name, words = f"joint {chain.names[k]}", "left out, as asked"
        if time[k] >= 0 and not ratio[k] > 0:
            read.leave("limits", name, "a damping ratio of 0")
        if lower[k] >= upper[k]:
            read.leave("limits", name, "a range that its margins fill")
        if not dropped:
            words = (
                f"JointStops of {stiffness[k]:.3g} N/m or N m/rad, about as stiff as "
            )
            words += "MuJoCo's soft constraint"
        read.note(name, f"range {lower[k]:.4g} to {upper[k]:.4g}: {words}")
    if dropped:
        return []
    return [JointStops(lower, upper, stiffness=stiffness, damping=_STOP_DAMPING)]


def springs_of_tendons(read: Reader, chain: Chain) -> list[Element]:
    """Springs and dampers of tendons, as elements."""
    model, forces = read.model, []
    no_limits = read.disabled("LIMIT", "CONSTRAINT")
    sprung, damped = (not read.disabled("PASSIVE", f) for f in ("SPRING", "DAMPER"))
    for tendon in range(model.ntendon):
        name = f"tendon {read.name_of('tendon', tendon)}"
        if not (chain.links[_bodies_of(read, tendon)] > 0).any():
            read.note(name, "left out, beside the arm")
            continue
        if "tendons" in read.drop:
            read.note(name, "left out, as asked")
            continue
        for array, kind, what in (
            ("tendon_limited", "limits", _RANGE),
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
        stiffness = sprung * float(model.tendon_stiffness[tendon])
        damping = damped * float(model.tendon_damping[tendon])
        law = stiffness, damping, *map(float, model.tendon_lengthspring[tendon])
        if not stiffness and not damping:
            continue
        elif points := _ends(read, chain, tendon):
            forces += _springs(points, *law)
            read.note(name, "SpringDamper")
        elif (gear := sum_of(read, chain, tendon)) is not None:
            forces.append(_spring_of_sum(gear, *law))
            read.note(name, "Actuators, that act as its spring and damper")
        else:
            what = "a spring that is neither between two sites nor on joints of it"
            read.leave("tendons", name, what)
    return forces


def _spring_of_sum(
    gear: np.ndarray, k: float, damping: float, low: float, high: float
) -> Actuators:
    """A spring, slack between two lengths, and a damper on a sum of positions."""
    bias = [[k * low, -k, 0], [k * high, -k, 0], [0, 0, -damping]]
    ends: Any = dict(lower=[0, -np.inf, -np.inf], upper=[np.inf, 0, np.inf])
    if low == high:
        bias, ends = [[k * low, -k, -damping]], {}
    zero = np.zeros((len(bias), 3))
    return Actuators([gear] * len(bias), zero, bias, zero[:, 0], **ends)


def _springs(
    points: tuple[Point, Point], k: float, damping: float, low: float, high: float
) -> list[SpringDamper]:
    """Springs that are slack between two lengths; the damper always acts."""
    if low == high:
        return [SpringDamper(*points, stiffness=k, damping=damping, rest_length=low)]
    springs = [SpringDamper(*points, damping=damping)] if damping else []
    for side, length, there in (("bumper", low, low > 0), ("cable", high, high < FAR)):
        if there and k:
            keywords: Any = dict(stiffness=k, rest_length=length, one_sided=side)
            springs.append(SpringDamper(*points, **keywords))
    return springs


def _bodies_of(read: Reader, tendon: int) -> list[int]:
    """The bodies on which a tendon acts."""
    model, path = read.model, read.path_of_tendon(tendon)
    on_geom = model.geom_bodyid
    owners = (
        None,
        model.jnt_bodyid,
        None,
        model.site_bodyid,
        on_geom,
        on_geom,
    )  # mjtWrap
    parts = zip(model.wrap_type[path], model.wrap_objid[path])
    return [owners[kind][thing] for kind, thing in parts if owners[kind] is not None]


def _ends(read: Reader, chain: Chain, tendon: int) -> tuple[Point, Point] | None:
    """The points of a tendon between two sites in the arm's plane."""
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
    local = chain.plane(places) - chain.starts[links]
    local *= np.exp(-1j * chain.turns[links])
    a, b = (Point(int(link), p.real, p.imag) for link, p in zip(links, local))
    return a, b
