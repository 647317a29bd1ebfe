"""Import of planar chains from MuJoCo's models: MJCF and URDF."""

import importlib
import warnings
from html import escape
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .. import Element, Linkage, State
from .actuators import actuators
from .chain import Chain, Reader, planar_chain
from .checks import refusal
from .elements import elements_in_joints, springs_of_tendons
from .source import compiled_model

KINDS = (
    "actuators", "armature", "contacts", "damping", "equalities", "fluid", "friction",
    "gravcomp", "limits", "plugins", "springs", "tendons",
)  # fmt: skip
# A fluid whose forces are this part of all others at a rate of 1 rad/s or 1 m/s is
# taken for none.
_NEGLIGIBLE = 1e-9


class Account(NamedTuple):
    """What `from_mjcf` made of each part of a model: a table that prints itself.

    - `lines`: pairs of a part of the model, and of what it became or why it was left
      out.
    """

    lines: list[tuple[str, str]]

    def __str__(self) -> str:
        width = max(len(part) for part, _ in self.lines)
        return "\n".join(f"{part:{width}}  {words}" for part, words in self.lines)

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"


class MjcfModel(NamedTuple):
    """A model as `from_mjcf` reads it.

    - `linkage`, `state0` [m or rad; m/s or rad/s], `forces`: what `simulate` takes.
    - `account`: a table of what became of each part; `account.lines` has its rows.
    """

    linkage: Linkage
    state0: State
    forces: tuple[Element, ...]
    account: Account


def from_mjcf(
    source: Any,
    *,
    controls: ArrayLike | None = None,
    tip: str | None = None,
    drop: tuple[str, ...] = (),
) -> MjcfModel:
    """Reads a planar chain of hinges and slides from a model of MuJoCo (MJCF or URDF).

    The plane is seen from where the first hinge's axis points, with gravity downwards,
    so that x may be -X of the model's world, as the account says;
    gravity across the plane has no effect. `q` equals `qpos`, with the opposite sign at
    hinges that turn the other way. A body with several joints becomes as many links,
    all but the last without mass. What is welded belongs to its link. Chains beside the
    arm are left out: the arm is the chain with most actuators, or else most joints.
    MuJoCo reads the model, which needs `pip install "fdof_jax[test]"`.

    Damping, armature, springs, actuators and spatial tendons between two sites become
    elements that act alike: position and velocity servos a `PDController`, motors a
    `JointEffort`, others `Actuators`. MuJoCo's soft ranges become `JointStops` that are
    about as stiff, and its friction loss `JointFriction`, which holds still where
    MuJoCo's creeps. What the library does not have is refused, or left out on purpose
    by `drop`. The `account` says all of it.

    **Arguments:**

    - `source`: an XML text, which may name no other files; the path of a file, an
      `mujoco.MjModel` or an `mujoco.MjSpec`.
    - `controls`: of the actuators, in MuJoCo's order and units; by default those of the
      first key frame, or 0. `replace` changes them in the elements.
    - `tip`: name of the site or body that is the tip; by default one named tip, ee,
      tool, hand or end_effector on the last link, or else the end of its last geom, or
      its last body.
    - `drop`: kinds of parts to leave out: "actuators", "armature", "contacts",
      "damping", "equalities", "fluid", "friction", "gravcomp", "limits", "plugins",
      "springs", "tendons".

    **Returns:** an `MjcfModel`: linkage, start (of the first key frame, or `qpos0`),
    forces and account.

    **Raises:** ValueError for what is no planar chain (trees, loops, other joints, axes
    out of the plane), for parts that are neither known nor to be dropped, and for
    bodies that touch at the start. Warns of bodies that may touch later.

    >>> import fdof_jax as fj
    >>> arm, start, forces, account = fj.from_mjcf('''
    ... <mujoco><worldbody><body><joint name="j" axis="0 1 0" damping="2"/>
    ... <geom type="capsule" fromto="0 0 0 0 0 -1" size=".1"/></body></worldbody>
    ... <actuator><position joint="j" kp="9" kv="1"/></actuator></mujoco>''')
    >>> print(account)
    plane       x = -X, y = Z of the model's world
    joint j     R1, a hinge, q = qpos
    tip         the end of the last geom
    joint j     damping 2: JointDamper
    actuator 0  PDController, at a control of 0
    start       qpos0, at rest
    """
    try:
        mujoco = importlib.import_module("mujoco")
    except ImportError as error:
        raise ImportError(
            "mujoco is not installed: pip install 'fdof_jax[test]' installs it."
        ) from error
    drop = (drop,) if isinstance(drop, str) else drop
    if not isinstance(drop, tuple | list):
        raise refusal("drop", f"a tuple of kinds among {KINDS}", drop)
    for kind in drop:
        if kind not in KINDS:
            raise refusal("drop", f"kinds among {KINDS}", kind)
    if tip is not None and not isinstance(tip, str):
        raise refusal("tip", "the name of a site or a body", tip)
    model, left = compiled_model(mujoco, source)
    read = Reader(mujoco, model, drop, [])
    for what in left:
        read.note("source", f"left out: {what}")
    linkage, chain = planar_chain(read, tip)
    forces = [
        *elements_in_joints(read, chain),
        *springs_of_tendons(read, chain),
        *actuators(read, chain, controls),
    ]
    _check_rest(read, chain)
    start = _start(read, chain)
    _check_contacts(read, chain)
    return MjcfModel(linkage, start, tuple(forces), Account(read.lines))


def _start(read: Reader, chain: Chain) -> State:
    data = read.data_at_start()
    frames = [read.name_of("key", k) for k in range(read.model.nkey)]
    words = f"key frame {frames[0]}" if frames else "qpos0, at rest"
    others = f", not {', '.join(frames[1:])}" if frames[1:] else ""
    read.note("start", words + others)
    q, qd = data.qpos[chain.places], data.qvel[chain.rates]
    if not (np.isfinite(q).all() and np.isfinite(qd).all()):
        raise refusal("source", "a finite start", [q.tolist(), qd.tolist()])
    return State(chain.signs * q, chain.signs * qd)


def _check_rest(read: Reader, chain: Chain) -> None:
    """Leaves out constraints, compensated gravity and fluids, or raises ValueError."""
    model, mujoco = read.model, read.mujoco
    things = mujoco.mjtObj
    if not read.disabled("EQUALITY", "CONSTRAINT"):
        for index in range(model.neq):
            name = f"equality {read.name_of('equality', index)}"
            kind = mujoco.mjtEq(int(model.eq_type[index]))
            of_bodies = kind in (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)
            ends = np.array([model.eq_obj1id[index], model.eq_obj2id[index]])
            ends = ends[ends >= 0]
            if of_bodies and things(int(model.eq_objtype[index])) == things.mjOBJ_SITE:
                ends = model.site_bodyid[ends]
            elif kind == mujoco.mjtEq.mjEQ_JOINT:
                ends, of_bodies = model.jnt_bodyid[ends], True
            if not model.eq_active0[index]:
                read.note(name, "left out, as it is not active")
            elif of_bodies and (chain.links[ends] <= 0).all():
                read.note(name, "left out, beside the arm")
            else:
                read.leave("equalities", name, "a loop or another constraint")
    for body in np.flatnonzero(chain.links > 0):
        name = f"body {read.name_of('body', body)}"
        if model.body_plugin[body] >= 0:
            read.leave("plugins", name, "a plugin")
        if model.body_gravcomp[body] and chain.gravity > 0:
            read.leave("gravcomp", name, "compensated gravity (gravcomp)")
    density, viscosity = float(model.opt.density), float(model.opt.viscosity)
    fluid = f"density {density:g}, viscosity {viscosity:g}"
    if (density or viscosity) and _drag(read, chain) > _NEGLIGIBLE:
        read.leave("fluid", "the model", f"a fluid of {fluid}")
    elif density or viscosity:
        read.note("fluid", f"{fluid}: left out, without effect on the arm")


def _drag(read: Reader, chain: Chain) -> float:
    """Greatest force of the fluid over that of inertia, at random rates of size 1."""
    model, rates, ratios = read.model, chain.rates, [0.0]
    data, draw = read.data_at_start(), np.random.default_rng(0)
    for _ in range(5):
        data.qpos[chain.places] = draw.normal(size=len(rates))
        data.qvel[rates] = draw.normal(size=len(rates))
        read.mujoco.mj_forward(model, data)
        others = abs(data.qfrc_bias[rates]).max() + model.dof_M0[rates].max()
        ratios.append(abs(data.qfrc_fluid[rates]).max() / others)
    return max(ratios)


def _check_contacts(read: Reader, chain: Chain) -> None:
    """Raises ValueError for bodies that touch at the start, warns of those that may."""
    model, mujoco, links = read.model, read.mujoco, chain.links
    if read.disabled("CONTACT", "CONSTRAINT"):
        return
    data = read.data_at_start()
    if "contacts" not in read.drop:
        try:
            mujoco.mj_fwdPosition(model, data)
        except mujoco.FatalError as error:  # thousands of contacts
            read.leave("contacts", "the model", str(error))
    name = lambda body: read.name_of("body", body)
    for contact in data.contact[: data.ncon]:
        a, b = model.geom_bodyid[contact.geom]
        touch = contact.geom.min() >= 0 and contact.dist <= 0
        if touch and max(links[a], links[b]) > 0:
            read.leave("contacts", f"bodies {name(a)} and {name(b)}", "a contact")
    if (pair := _may_collide(read, links)) is None:
        return
    both = " and ".join(map(name, pair))
    read.note("contacts", f"left out, though bodies {both} may collide")
    if "contacts" not in read.drop:
        warnings.warn(
            f"source: contacts are left out, but bodies {both} of this model may "
            "collide; drop=('contacts',) omits this warning.",
            stacklevel=3,
        )


def _may_collide(read: Reader, links: np.ndarray) -> tuple[int, int] | None:
    """Two bodies, one of the arm, whose geoms may collide in MuJoCo, if any.

    Geoms of bodies that are welded together, or next to each other in the chain, do
    not; the moving bodies next to the ground may collide with it.
    """
    model = read.model
    bodies = model.geom_bodyid
    pairs = [*zip(bodies[model.pair_geom1], bodies[model.pair_geom2])]
    welded, before = model.body_weldid, model.body_weldid[model.body_parentid]
    # There may be thousands of geoms, of which few are different.
    owner = bodies if model.nexclude else welded[bodies]
    kinds = np.stack([owner, model.geom_contype, model.geom_conaffinity], axis=1)
    kinds = np.unique(kinds, axis=0)
    body = kinds[:, 0]
    a, b = np.triu_indices(len(kinds), 1)
    meet = (kinds[a, 1] & kinds[b, 2]) | (kinds[b, 1] & kinds[a, 2])
    u, v = welded[body[a]], welded[body[b]]
    next_to = ((u > 0) & (before[v] == u)) | ((v > 0) & (before[u] == v))
    next_to &= not read.disabled("FILTERPARENT")
    excluded = np.isin((body[a] << 16) + body[b], model.exclude_signature)
    may = (meet != 0) & (u != v) & ~next_to & ~excluded
    pairs += zip(body[a[may]], body[b[may]])
    return next((pair for pair in pairs if max(links[[*pair]]) > 0), None)
