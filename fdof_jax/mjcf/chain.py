"""The planar chain in a MuJoCo model: joints, plane, links and tip."""

import warnings
from collections.abc import Sequence
from types import ModuleType
from typing import Any, NamedTuple, SupportsInt

import numpy as np
from numpy.typing import ArrayLike

from .. import Linkage
from ..checks import plain, refusal
from .source import Model

Data = Any  # a `mujoco.MjData`
_SLIDE, _HINGE, _OF_JOINTS = 2, 3, 2  # of MuJoCo's mjtJoint and mjtEq
FAR = 1e9  # stands for infinity where MuJoCo wants a number
_EXACT = 1e-9  # what is as far out of the plane is taken for rounding
_FLAT = 1e-5  # and what is as far [rad] is laid into the plane, with a remark
_NOTHING = 1e-13  # MuJoCo's least masses and inertias, of 1e-15 per body, stand for 0
_TIPS = ("tip", "ee", "tool", "hand", "end_effector")


class Chain(NamedTuple):
    """The place of a model's chain, and its plane.

    - `joints`: their ids; `names`, `places` (in qpos) and `rates` (in qvel), (n,).
    - `links`: of each body: 0 for the ground, -1 beside the chain.
    - `signs`: (n,), -1 for hinges that turn against the first; q = signs * qpos.
    - `right`, `up`, `normal`: unit vectors; `gravity` [m/s^2] points against `up`.
    - `starts`: characteristic points of ground and links, (n + 1,); `turns`: angles
      [rad]; both at qpos = 0.
    """

    joints: np.ndarray
    names: list[str]
    places: np.ndarray
    rates: np.ndarray
    links: np.ndarray
    signs: np.ndarray
    right: np.ndarray
    up: np.ndarray
    normal: np.ndarray
    gravity: float
    starts: np.ndarray
    turns: np.ndarray

    def plane(self, vectors: np.ndarray) -> Any:
        """Complex components of vectors: to the right and upwards."""
        return vectors @ self.right + 1j * (vectors @ self.up)


class Reader(NamedTuple):
    """A model, the kinds of parts to leave out, and the lines of the account."""

    mujoco: ModuleType
    model: Model
    drop: Sequence[str]
    lines: list[tuple[str, str]]

    def name_of(self, kind: str, index: SupportsInt) -> str:
        """The name of a part, such as a body, or its number."""
        return getattr(self.model, kind)(int(index)).name or str(int(index))

    def has(self, array: str, index: int) -> np.bool_ | bool:
        """Returns whether an array, which older versions may lack, is not 0 there."""
        return hasattr(self.model, array) and np.any(getattr(self.model, array)[index])

    def disabled(self, *names: str) -> bool:
        """Returns whether a flag of one of these names switches something off."""
        flags = self.mujoco.mjtDisableBit.__members__  # some in some versions only
        bits = [int(flags[f"mjDSBL_{n}"]) for n in names if f"mjDSBL_{n}" in flags]
        return any(self.model.opt.disableflags & bit for bit in bits)

    def data_at_start(self) -> Data:
        """MuJoCo's data in the first key frame if there is one, else at qpos0."""
        data = self.mujoco.MjData(self.model)
        if self.model.nkey:
            self.mujoco.mj_resetDataKeyframe(self.model, data, 0)
        for joint, place in self.locked().values():
            data.qpos[self.model.jnt_qposadr[joint]] = place
        return data

    def locked(self) -> dict[int, tuple[int, float]]:
        """Joints that equalities hold, and where in qpos, by equality."""
        model, held = self.model, {}
        if "equalities" in self.drop or self.disabled("EQUALITY", "CONSTRAINT"):
            return held
        for index in np.flatnonzero(model.eq_active0):
            follows = model.eq_obj2id[index] >= 0 and model.eq_data[index, 1:5].any()
            if model.eq_type[index] == _OF_JOINTS and not follows:
                joint = int(model.eq_obj1id[index])
                rest = model.qpos0[model.jnt_qposadr[joint]]
                held[int(index)] = joint, float(rest + model.eq_data[index, 0])
        return held

    def path_of_tendon(self, tendon: int) -> slice:
        """Returns the places of the parts of a tendon's path."""
        begin = int(self.model.tendon_adr[tendon])
        return slice(begin, begin + int(self.model.tendon_num[tendon]))

    def bounds(
        self, kind: str, index: int | np.ndarray, signs: ArrayLike = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Both ends of ranges, infinite where there is none or it is `FAR`.

        `kind` is the prefix of the arrays, as jnt_ of jnt_range.
        """
        limited = np.asarray(getattr(self.model, f"{kind}limited")[index], bool)
        ends = signs * getattr(self.model, f"{kind}range")[index].T
        low, high = np.sort(ends, axis=0)
        low = np.where(limited & (low > -FAR), low, -np.inf)
        return low, np.where(limited & (high < FAR), high, np.inf)

    def note(self, part: str, words: str) -> None:
        """Adds a line to the account."""
        self.lines.append((plain(part), plain(words)))

    def leave(self, kind: str, part: str, what: str) -> None:
        """Notes what is left out; raises ValueError unless `drop` names its kind."""
        if kind not in self.drop:
            raise ValueError(
                f"source: expected a planar chain with elements of this library, got "
                f"{plain(part)} with {plain(what)}; drop=('{kind}',) leaves it out."
            )
        self.note(part, f"{what}: left out, as asked")


def planar_chain(read: Reader, tip: str | None) -> tuple[Linkage, Chain]:
    """Reads the chain and its masses; raises ValueError if there is none."""
    model = read.model
    pull = np.zeros(3) if read.disabled("GRAVITY") else model.opt.gravity
    if not np.isfinite(pull).all():
        raise refusal("source", "finite gravity", pull.tolist())
    joints, links = _joints_of_arm(read, tip)
    data = read.data_at_start()
    places = model.jnt_qposadr[joints]
    data.qpos[places] = 0
    read.mujoco.mj_kinematics(model, data)
    read.mujoco.mj_comPos(model, data)
    axes, slides = data.xaxis[joints], model.jnt_type[joints] == _SLIDE
    names = [read.name_of("joint", k) for k in joints]
    right, up, normal, gravity = _plane(axes, slides, pull)
    signs = np.where(slides, 1, np.sign(axes @ normal))
    x, y = _direction(right), _direction(up)
    read.note("plane", f"x = {x}, y = {y} of the model's world")
    _note_joints(read, names, axes, slides, normal)
    chain = Chain(
        joints, names, places, model.jnt_dofadr[joints], links, signs, right, up,
        normal, gravity, np.zeros(0), np.zeros(0),
    )  # fmt: skip
    starts = [0j]
    for joint, slide in zip(joints, slides):
        starts.append(starts[-1] if slide else chain.plane(data.xanchor[joint]))
    chain = chain._replace(starts=np.array(starts))
    place, words = _tip(read, data, chain, tip)
    read.note("tip", words)
    linkage, turns = _linkage(model, data, chain, slides, place)
    return linkage, chain._replace(turns=turns)


def _direction(vector: np.ndarray) -> str:
    """Names a unit vector: "-X", or its components."""
    axis = int(np.abs(vector).argmax())
    if abs(vector[axis]) < 1 - 1e-9:
        return f"({', '.join(f'{part:.4g}' for part in vector)})"
    return ("-" if vector[axis] < 0 else "") + "XYZ"[axis]


def _named(read: Reader, name: str) -> tuple[int, str, int] | None:
    """The body of a site or a body with this name, and which of both it is."""
    model, mujoco = read.model, read.mujoco
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
    if site >= 0:
        return int(model.site_bodyid[site]), "site", site
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    return (body, "body", body) if body > 0 else None


def _joints_of_arm(read: Reader, tip: str | None) -> tuple[np.ndarray, np.ndarray]:
    """The arm's joints, and the link of each body; notes chains beside it."""
    model, name = read.model, lambda body: read.name_of("body", body)
    welded, tree_of = model.body_weldid, model.body_treeid  # -1 of what stands still
    refuse = lambda what: ValueError(f"source: expected a planar chain, got {what}.")
    if model.ntree == 0:
        raise refuse("a model without joints")
    of_joint = tree_of[model.jnt_bodyid]
    if tip is not None:
        if (at := _named(read, tip)) is None:
            sites = [model.site(k).name for k in range(model.nsite)]
            bodies = [model.body(k).name for k in range(1, model.nbody)]
            names = plain(str([each for each in sites + bodies if each]))
            raise refusal("tip", f"a site or a body among {names}", tip)
        chosen = tree_of[at[0]]
        if chosen < 0:
            raise refusal("tip", "a site or a body that moves", tip)
    else:
        moved = model.actuator_trnid[model.actuator_trntype == 0, 0]
        driven = of_joint[moved].tolist()

        def rank(tree: int) -> tuple:
            kinds = model.jnt_type[of_joint == tree]
            simple = np.isin(kinds, (_SLIDE, _HINGE)).all()
            return simple, driven.count(tree), len(kinds), -tree

        chosen = max(range(model.ntree), key=rank)
    for tree in range(model.ntree):
        if tree != chosen:
            first = np.argmax(tree_of == tree)
            read.note(f"chain of body {name(first)}", "left out, beside the arm")
    joints = np.flatnonzero(of_joint == chosen)
    for joint in joints:
        if model.jnt_type[joint] not in (_HINGE, _SLIDE):
            kind = f"joint {read.name_of('joint', joint)}"
            raise refuse(f"{kind}, which is neither a hinge nor a slide")
    # Bodies that are welded together are one.
    bodies = np.unique(welded[tree_of == chosen])
    before = welded[model.body_parentid[bodies]]
    for body in bodies:
        following = bodies[before == body]
        if len(following) > 1:
            both = " and ".join(map(name, following[:2]))
            raise refuse(f"branches: bodies {both} both follow body {name(body)}")
    free = ~np.isin(joints, [joint for joint, _ in read.locked().values()])
    if not free.any():
        raise refuse("joints that are all locked")
    links = np.where(tree_of < 0, 0, -1)
    for k, body in zip(np.cumsum(free), model.jnt_bodyid[joints]):
        links[welded == body] = k  # of several joints of a body, the last one
    return joints[free], links


def _plane(
    axes: np.ndarray, slides: np.ndarray, pull: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Unit vectors to the right, upwards and out of the plane, and gravity [m/s^2]."""
    unit = lambda vector: vector / np.linalg.norm(vector)
    if not slides.all():
        normal = axes[np.argmin(slides)]
    else:  # out of the plane of two slides, or of a slide and gravity
        across = np.cross(axes[0], [*axes[1:], -pull, *np.eye(3)])
        normal = across[np.argmax(np.linalg.norm(across, axis=1) > _EXACT)]
    normal = unit(normal)
    within = lambda vector: vector - (vector @ normal) * normal
    gravity = float(np.linalg.norm(within(pull)))  # what is across moves nothing
    gravity = gravity if gravity > _EXACT else 0.0
    # Without gravity, some direction in the plane is upwards.
    choices = (-pull, np.roll(normal, 1), np.cross(normal, [1, 0, 0]))
    up = unit(next(w for w in map(within, choices) if np.linalg.norm(w) > _EXACT))
    return np.cross(up, normal), up, normal, gravity


def _note_joints(
    read: Reader, names: list[str], axes: np.ndarray, slides: np.ndarray,
    normal: np.ndarray,
) -> None:  # fmt: skip
    """Notes the joints; raises ValueError for an axis that is off."""
    for k, (name, axis, slide) in enumerate(zip(names, axes, slides), start=1):
        kind = f"P{k}, a slide" if slide else f"R{k}, a hinge"
        minus = "" if slide or axis @ normal > 0 else "-"
        read.note(f"joint {name}", f"{kind}, q = {minus}qpos")
        along, across = abs(axis @ normal), np.linalg.norm(np.cross(axis, normal))
        angle = np.arctan2(along, across) if slide else np.arctan2(across, along)
        if angle > _FLAT:
            where = "in the plane" if slide else "along the first hinge's"
            raise ValueError(
                f"source: expected the axis of joint {name} {where}, got one "
                f"{angle:.2g} rad off. A spec = mujoco.MjSpec.from_file(path) is read "
                f"without it after spec.delete(spec.joint('{name}'))."
            )
        if angle > _EXACT:
            off = f"axis laid into the plane, {angle:.1g} rad off"
            read.note(f"joint {name}", off)


def _tip(
    read: Reader, data: Data, chain: Chain, tip: str | None
) -> tuple[complex, str]:
    """The place of the tip, and words on what it is."""
    model, kinds = read.model, read.mujoco.mjtGeom
    count, start = len(chain.joints), complex(chain.starts[-1])
    for name in _TIPS if tip is None else (tip,):
        if (at := _named(read, name)) is None:
            continue
        body, kind, index = at
        if chain.links[body] == count:
            place = data.site_xpos[index] if kind == "site" else data.xpos[index]
            return chain.plane(place), f"the {kind} {name}"
        if tip is not None:
            raise ValueError(
                "tip: expected a place on the last body that moves or on one welded to "
                f"it, got one on body {read.name_of('body', body)}."
            )
    geoms = np.flatnonzero(chain.links[model.geom_bodyid] == count)
    if geoms.size == 0:
        body = np.flatnonzero(chain.links == count)[-1]
        if body != model.jnt_bodyid[chain.joints[-1]]:
            name = read.name_of("body", body)
            return chain.plane(data.xpos[body]), f"the body {name}"
        return start, "the last joint, as there is nothing beyond it"
    geom = geoms[-1]
    center = data.geom_xpos[geom]
    kind = kinds(int(model.geom_type[geom]))
    if kind in (kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER):
        reach = model.geom_size[geom, 1] * data.geom_xmat[geom].reshape(3, 3)[:, 2]
        ends = chain.plane(np.array([center + reach, center - reach]))
        return ends[abs(ends - start).argmax()], "the end of the last geom"
    return chain.plane(center), "the centre of the last geom"


def _linkage(
    model: Model, data: Data, chain: Chain, slides: np.ndarray, tip: complex
) -> tuple[Linkage, np.ndarray]:
    """The linkage with `q` = 0 where the links are, and the angles of its links.

    A link before a slide is at right angles to it, all others are parallel to the next.
    """
    starts, turns = chain.starts, [float(np.angle(tip - chain.starts[-1]))]
    for joint, slide in zip(chain.joints[::-1], slides[::-1]):
        axis = chain.plane(data.xaxis[joint])
        turns.append(float(np.angle(-1j * axis)) if slide else turns[-1])
    turns = np.array(turns[::-1])
    steps = np.diff([*starts, tip]) * np.exp(-1j * turns)
    count = len(chain.joints)
    offsets, (masses, inertias) = np.zeros(count, complex), np.zeros((2, count))
    for k in range(count):
        bodies = np.flatnonzero(chain.links == k + 1)  # none between joints of one body
        mass, places = model.body_mass[bodies], chain.plane(data.xipos[bodies])
        if not mass.sum() > 0:
            continue
        masses[k] = mass.sum()
        center = mass @ places / masses[k]
        frames = data.ximat[bodies].reshape(-1, 3, 3)
        own = (frames.transpose(0, 2, 1) @ chain.normal) ** 2
        inertias[k] = (own * model.body_inertia[bodies]).sum()
        inertias[k] += mass @ np.abs(places - center) ** 2
        offsets[k] = (center - starts[k + 1]) * np.exp(-1j * turns[k + 1])
    masses, inertias = (np.where(v > _NOTHING, v, 0) for v in (masses, inertias))
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*moves no inertia of link")
            linkage = Linkage(
                "".join("P" if slide else "R" for slide in slides),
                length=steps.real,
                com=np.column_stack([np.real(offsets), np.imag(offsets)]),
                mass=masses,
                inertia=inertias,
                locked=np.where(slides, np.diff(turns), steps.imag[:-1]),
                base_angle=turns[0],
                gravity=chain.gravity,
            )
    except ValueError as error:
        raise ValueError(f"source: expected a planar chain; {error}") from error
    return linkage, turns
