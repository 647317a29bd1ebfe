"""Import of planar chains from MuJoCo's models: MJCF and URDF."""

import importlib
import warnings
from html import escape
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .. import Element, Linkage, State
from ..checks import refusal
from .actuators import actuators
from .chain import Chain, Reader, planar_chain
from .elements import elements_in_joints, springs_of_tendons
from .source import compiled_model

KINDS = (
    "actuators", "armature", "contacts", "damping", "equalities", "fluid", "friction",
    "gravcomp", "limits", "plugins", "springs", "tendons",
)  # fmt: skip
# A fluid with this part of all forces, at rates of size 1, is taken for none.
_NEGLIGIBLE = 1e-9


class Account(NamedTuple):
    """A table of what became of each part of a model; prints itself.

    - `lines`: pairs of a part, and of what it became or why it was left out.
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

    The first hinge's axis points at the viewer and gravity downwards, so x may be -X of
    the model's world. `q` equals `qpos`, or -`qpos` at hinges that turn the other way.
    The arm is the chain of `tip`, or else that with most actuators, or else most
    joints. The account says what became of each part. MuJoCo compiles the model:
    `pip install "fdof_jax[test]"`.

    **Arguments:**

    - `source`: an XML text, which may name no other files, or the path of a file, a
      `mujoco.MjModel` or a `mujoco.MjSpec`.
    - `controls`: of the actuators, in MuJoCo's order and units; by default those of the
      first key frame, or 0.
    - `tip`: name of the site or body that is the tip; by default one named tip, ee,
      tool, hand or end_effector on the last link, or else the end of its last geom (a
      capsule or cylinder; the centre of another), or its last body.
    - `drop`: kinds of parts to leave out: "actuators", "armature", "contacts",
      "damping", "equalities", "fluid", "friction", "gravcomp", "limits", "plugins",
      "springs", "tendons".

    **Returns:** an `MjcfModel`, at the start of the first key frame or at `qpos0`.

    **Raises:** ImportError without MuJoCo. ValueError for what is no planar chain, for
    parts neither known nor dropped, and for bodies that touch at the start. Warns of
    bodies that may touch later.

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
    if unknown := [kind for kind in drop if kind not in KINDS]:
        raise refusal("drop", f"kinds among {KINDS}", unknown[0])
    if tip is not None and not isinstance(tip, str):
        raise refusal("tip", "the name of a site or a body", tip)
    model, remarks, robot = compiled_model(mujoco, source)
    read = Reader(mujoco, model, drop, [])
    for words in remarks:
        read.note("source", words)
    linkage, chain = planar_chain(read, tip)
    forces = [
        *elements_in_joints(read, chain),
        *springs_of_tendons(read, chain),
        *actuators(read, chain, controls),
    ]
    _check_rest(read, chain)
    start = _start(read, chain)
    _check_contacts(read, chain, robot)
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
    model, held = read.model, read.locked()
    owners = {1: np.arange(model.nbody), 6: model.site_bodyid}  # by MuJoCo's mjtObj
    for index in range(0 if read.disabled("EQUALITY", "CONSTRAINT") else model.neq):
        name = f"equality {read.name_of('equality', index)}"
        of_joints = int(model.eq_type[index]) == int(read.mujoco.mjtEq.mjEQ_JOINT)
        owner = model.jnt_bodyid if of_joints else owners.get(model.eq_objtype[index])
        ends = np.array([model.eq_obj1id[index], model.eq_obj2id[index]])
        if not model.eq_active0[index]:
            read.note(name, "left out, as it is not active")
        elif index in held:
            joint = read.name_of("joint", held[index][0])
            read.note(name, f"joint {joint} is fixed at {held[index][1]:.4g}")
        elif owner is not None and (chain.links[owner[ends[ends >= 0]]] <= 0).all():
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
    """The fluid's force over that of inertia, in a random state of size 1."""
    model, rates, data = read.model, chain.rates, read.data_at_start()
    state = np.random.default_rng(0).normal(size=(2, len(rates)))
    data.qpos[chain.places], data.qvel[rates] = state
    read.mujoco.mj_forward(model, data)
    others = abs(data.qfrc_bias[rates]).max() + model.dof_M0[rates].max()
    return abs(data.qfrc_fluid[rates]).max() / others


def _check_contacts(read: Reader, chain: Chain, robot: bool) -> None:
    """Raises ValueError for bodies that touch at the start, warns of those that may.

    A `robot`, as in ROS, has no contacts between ground and first link.
    """
    model, mujoco, links = read.model, read.mujoco, chain.links
    if read.disabled("CONTACT", "CONSTRAINT"):
        return
    data = read.data_at_start()
    if "contacts" not in read.drop:
        try:
            mujoco.mj_fwdPosition(model, data)
        except mujoco.FatalError as error:  # thousands of contacts
            read.leave("contacts", "the model", str(error))
    both = lambda pair: "bodies " + " and ".join(read.name_of("body", b) for b in pair)
    apart = lambda pair: not (robot and sorted(links[[*pair]]) == [0, 1])
    for contact in data.contact[: data.ncon]:
        pair = model.geom_bodyid[contact.geom]
        touch = contact.geom.min() >= 0 and contact.dist <= 0
        if touch and max(links[pair]) > 0 and apart(pair):
            read.leave("contacts", both(pair), "a contact")
    pairs = [pair for pair in _may_collide(read) if max(links[[*pair]]) > 0]
    if not all(map(apart, pairs)):
        read.note("contacts", "left out between the ground and the first link")
    if not (words := next(map(both, filter(apart, pairs)), "")):
        return
    read.note("contacts", f"left out, though {words} may collide")
    if "contacts" not in read.drop:
        warnings.warn(
            f"source: contacts are left out, but {words} of this model may collide; "
            "drop=('contacts',) omits this warning.",
            stacklevel=3,
        )


def _may_collide(read: Reader) -> list[tuple[int, int]]:
    """Pairs of bodies whose geoms may collide in MuJoCo.

    Bodies that are welded together do not, nor do neighbours other than the ground.
    """
    model, bodies = read.model, read.model.geom_bodyid
    pairs = zip(bodies[model.pair_geom1], bodies[model.pair_geom2])
    welded, before = model.body_weldid, model.body_weldid[model.body_parentid]
    # There may be thousands of geoms, of which few are different.
    owner = bodies if model.nexclude else welded[bodies]
    kinds = np.stack([owner, model.geom_contype, model.geom_conaffinity])
    body, own, other = np.unique(kinds, axis=1)
    a, b = np.triu_indices(len(body), 1)
    meet = (own[a] & other[b]) | (own[b] & other[a])
    u, v = welded[body[a]], welded[body[b]]
    next_to = ((u > 0) & (before[v] == u)) | ((v > 0) & (before[u] == v))
    next_to &= not read.disabled("FILTERPARENT")
    excluded = np.isin((body[a] << 16) + body[b], model.exclude_signature)
    may = (meet != 0) & (u != v) & ~next_to & ~excluded
    return [*pairs, *zip(body[a[may]], body[b[may]])]
