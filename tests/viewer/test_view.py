"""A page of motions: what is in it, and what it rejects; in a browser: test_browser."""

import base64
import json
import re

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import PLAIN
from figures import LINKAGE, SOLUTION, made_up, make_linkage, swinging

import fdof_jax as fj
from fdof_jax import drawing
from fdof_jax.simulation import End, Events
from fdof_jax.viewer.lines import lines_of

ARM, TIP, MOTION = make_linkage("RPR"), fj.Point(3, 0.6), swinging()
LOADED = fj.forces.Payload(TIP, 0.4, begin=0.3, end=0.6)
BATCH = made_up(SOLUTION.ts, jnp.stack([SOLUTION.q] * 3), jnp.zeros((3, 5, 3)))


def data_of(html):
    return json.loads(re.search(r'<script id="data".*?>(.*?)</script>', html)[1])


@pytest.fixture
def show(tmp_path):
    """Returns the view and the data in its file."""

    def shown(*arguments):
        path = tmp_path / "motion.html"
        view = fj.view(*arguments, path=path)
        assert path.read_text() == view.html
        return view, data_of(view.html)

    return shown


def array(data, place):
    return np.frombuffer(base64.b64decode(data["arrays"][place]), np.float32)


def curves(data, shown):
    """Returns a motion's curves by panel and name."""
    return {(s["panel"], s["name"]): array(data, s["y"]) for s in shown["series"]}


def efforts(data, shown):
    found = [y for (panel, _), y in curves(data, shown).items() if panel == "effort"]
    return np.array(found).T


def test_rows_are_those_of_the_motion_in_32_bits(show):
    view, data = show(ARM, MOTION, (fj.JointDamper([1.0, 2.0, 3.0]),))
    (shown,) = data["motions"]
    series, forces = curves(data, shown), -np.array([1, 2, 3]) * np.asarray(MOTION.qd)
    for k, name in enumerate(("R1", "P2", "R3")):
        q = array(data, shown["q"][k])
        np.testing.assert_array_equal(q, np.float32(MOTION.q[:, k]))
        rows = dict(position=MOTION.q, velocity=MOTION.qd, effort=forces)
        for panel, row in rows.items():
            np.testing.assert_allclose(series[panel, name], row[:, k], rtol=1e-6)
    for row in (0, 50):
        energies = fj.energy(ARM, MOTION.q[row], MOTION.qd[row])
        for name, energy in zip(("kinetic", "potential"), energies):
            np.testing.assert_allclose(series["energy", name][row], energy, rtol=1e-6)
    units = {"rad", "m", "rad/s", "m/s", "N m", "N", "J"}
    assert {s["unit"] for s in shown["series"]} == units
    # A page is small and needs nothing else.
    assert len(view.html.encode()) - len(json.dumps(data)) < 60_000
    assert not re.search(r"https?://|@import|src=|href=", view.html)


HOOK = fj.Point(0, -1.0, 1.0)
PLACED = "spring", "cable", "bumper", "tension", "wrench", "following wrench", "stops"
DRAWN = (
    *map(PLAIN.get, PLACED),
    fj.Wrench(TIP, moment=lambda t: jnp.sin(9 * t)),
    fj.LinearActuator(HOOK, TIP, force=1.0),
    LOADED,
    fj.PDController(1.0, 1.0, 1.0, fj.CircleTask()),
)


def test_lines_are_those_of_the_drawing():
    g = drawing.geometry(ARM, MOTION.q, MOTION.ts, DRAWN)
    lines, further = lines_of(g.angle, g.points, 1e-5)
    starts = [g.points[f"link {k}"][:, 0] for k in (1, 2, 3)]
    columns = np.column_stack([np.exp(1j * g.angle), *starts, *further])
    assert [name for name, _ in lines] == [*g.points]
    for name, shares in lines:
        line = sum(np.outer(columns[:, k], share) for k, share in shares.items())
        np.testing.assert_allclose(line, g.points[name], atol=3e-5, err_msg=name)
    assert len(further) < 40 < g.all_points.shape[1]  # rows stay small


def test_a_batch_and_titles_make_many_motions(show):
    failed = eqx.tree_at(lambda s: s.q, BATCH, BATCH.q.at[1, 3:].set(jnp.nan))
    scaled = [LINKAGE.replace(length=k * LINKAGE.length) for k in (1, 2, 3)]
    arms = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scaled)
    _, data = show(arms, failed)
    about = [
        (motion["title"], array(data, motion["t"]).size, motion["length"][1])
        for motion in data["motions"]
    ]
    assert about == [("member 0", 5, 1), ("member 1", 3, 2), ("member 2", 5, 3)]
    arms, spring = {"a": LINKAGE, "b": ARM}, fj.SpringDamper(HOOK, TIP, stiffness=1)
    _, data = show(arms, {"a": SOLUTION, "b": swinging(7)}, {"a": (), "b": (spring,)})
    first, second = data["motions"]
    assert (first["title"], first["kinds"], second["kinds"]) == ("a", "RRR", "RPR")
    assert [m["lines"][0][0] for m in (first, second)] == ["link 0", "spring 0"]
    dampers = jax.vmap(fj.JointDamper)(jnp.ones((5, 3)))
    with pytest.raises(ValueError, match=r"^forces\[0\].* one set of forces\.$"):
        fj.view(LINKAGE, BATCH, (dampers,))


def changed(motion, **fields):
    return eqx.tree_at(
        lambda s: [getattr(s, name) for name in fields], motion, [*fields.values()],
        is_leaf=lambda leaf: leaf is None,
    )  # fmt: skip


def held():
    """A motion whose slide rests on its lower stop from 0.2 to 0.6 s, and that ends."""
    times, kinds = np.array([0.2, 0.6, np.nan]), np.array([3, 4, 0])
    modes, q = np.zeros((101, 3)), MOTION.q.at[81:].set(np.nan)
    modes[20:60, 1] = 2
    events = Events(times, np.array([2, 2, 2]), kinds, 2)
    end = End(np.array(0.805), q[0], q[0], np.array(1))
    taken = np.zeros(101)
    return changed(MOTION, q=q, modes=modes, taken=taken, events=events, end=end)


def test_events_modes_and_ends_are_marked(show):
    motion = held()
    (shown,) = (data := show(ARM, motion)[1])["motions"]
    assert shown["events"] == [
        [0.2, "P2 rests on its stop"], [0.6, "P2 leaves its stop"],
        [0.8, "condition 1 ends the motion"],
    ]  # fmt: skip
    marked = [array(data, place) for place in shown["modes"]]
    np.testing.assert_array_equal(np.stack(marked, axis=1), motion.modes[:81])
    assert not shown["ending"]
    reset = changed(MOTION, events=Events(*np.array([[0.5], [0], [8]]), 1))
    there = LOADED.replace(begin=0.0, end=None)  # from the start
    (shown,) = show(ARM, reset, (there, LOADED))[1]["motions"]
    assert shown["events"] == [
        [0.3, "a payload is picked up"], [0.5, "the state is reset"],
        [0.6, "a payload is released"],
    ]  # fmt: skip
    failed = changed(
        MOTION, q=MOTION.q.at[51:].set(jnp.nan), result=diffrax.RESULTS.nonfinite
    )
    assert show(ARM, failed)[1]["motions"][0]["ending"] == "not finite at 0.5 s"


def test_no_title_is_taken_for_the_page_that_a_notebook_shows(show):
    title = "</script><!--data--><b>\"'&"
    view, data = show(LINKAGE, {title: SOLUTION})
    assert data["motions"][0]["title"] == title
    assert "<b>\"'" not in view.html and view.html.count("</script>") == 2
    titles = ("a <i>", "b", "c", "d", "e", "f")
    view, _ = show(LINKAGE, dict.fromkeys(titles, SOLUTION))
    assert "<title>a &lt;i&gt;, b, c, d, e, ...</title>" in view.html
    view, _ = show(LINKAGE, SOLUTION)
    assert "<title>RRR arm</title>" in view.html
    assert repr(view) == f"View(path={view.path!r})"
    frame = view._repr_html_()
    assert frame.count('"') == frame.count('="') * 2  # the page ends no attribute
    assert "<script" not in frame and frame.startswith("<iframe")


def test_scenes_stand_for_linkages_and_their_own_forces(show):
    start = fj.State([0.0] * 3, [0.0] * 3)
    forces = [(fj.JointDamper(k),) for k in (1, 2)]
    before, after = (fj.Scene(ARM, start, own, 1.0) for own in forces)
    assert show(before, MOTION)[1] == show(ARM, MOTION, forces[0])[1]
    arms = {"before": before, "after": after, "free": ARM}
    _, data = show(arms, dict.fromkeys(arms, MOTION))
    one, other, free = (efforts(data, shown) for shown in data["motions"])
    np.testing.assert_array_equal(other, 2 * one)
    assert not free.size  # a free motion has no curves of efforts
    with pytest.raises(ValueError, match=r"got Scene\(linkage=.{183}\.{3}\.$"):
        fj.view(before, {"a": MOTION})  # what a message leaves out is told
    # Sampled motions come with their control; its efforts are those that acted.
    acting = np.arange(15.0).reshape(5, 3)
    motion = changed(SOLUTION, tau=acting, acting=acting)
    (shown,) = (data := show(LINKAGE, motion, (lambda *_: 0.0,))[1])["motions"]
    np.testing.assert_array_equal(efforts(data, shown), acting)
