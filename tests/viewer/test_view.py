"""A page of motions: what is in it, and what it refuses; in a browser: test_browser."""

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

ARM, TIP = make_linkage("RPR"), fj.Point(3, 0.6)
REST = fj.State([0.0] * 3, [0.0] * 3)
BATCH = made_up(SOLUTION.ts, jnp.stack([SOLUTION.q] * 3), jnp.zeros((3, 5, 3)))


@pytest.fixture
def show(tmp_path):
    """Returns the view and the data in its file."""

    def shown(*arguments):
        path = tmp_path / "motion.html"
        view = fj.view(*arguments, path=path)
        assert path.read_text() == view.html
        return view, data_of(view.html)

    return shown


def data_of(html):
    return json.loads(re.search(r'<script id="data".*?>(.*?)</script>', html)[1])


def array(data, place, kind=np.float32):
    return np.frombuffer(base64.b64decode(data["arrays"][place]), kind)


def test_rows_are_those_of_the_motion_in_32_bits(show):
    damper = fj.JointDamper([1.0, 2.0, 3.0])
    motion = swinging()
    view, data = show(ARM, motion, (damper,))
    (shown,) = data["motions"]
    series = {(s["panel"], s["name"]): array(data, s["y"]) for s in shown["series"]}
    energies = [fj.energy(ARM, q, qd) for q, qd in zip(motion.q[::50], motion.qd[::50])]
    for k, name in enumerate(("R1", "P2", "R3")):
        np.testing.assert_array_equal(
            array(data, shown["q"][k]), np.float32(motion.q[:, k])
        )
        for panel, values in (
            ("position", motion.q), ("velocity", motion.qd),
            ("effort", -np.array([1, 2, 3]) * np.asarray(motion.qd)),
        ):  # fmt: skip
            found = series[panel, name]
            np.testing.assert_allclose(found, values[:, k], rtol=1e-6)
    for name, values in zip(("kinetic", "potential"), zip(*energies)):
        np.testing.assert_allclose(series["energy", name][::50], values, rtol=1e-6)
    assert {s["unit"] for s in shown["series"]} == {
        "rad", "m", "rad/s", "m/s", "N m", "N", "J"
    }  # fmt: skip
    # A free motion has no curves of efforts.
    assert "effort" not in {
        s["panel"] for s in show(ARM, motion)[1]["motions"][0]["series"]
    }


def test_a_page_is_small_and_needs_nothing_else(show):
    view, data = show(ARM, swinging())
    assert len(view.html.encode()) - len(json.dumps(data)) < 60_000
    assert not re.search(r"https?://|@import|src=|href=", view.html)


HOOK = fj.Point(0, -1.0, 1.0)
PLACED = "spring", "cable", "bumper", "tension", "wrench", "following wrench", "stops"
DRAWN = (
    *map(PLAIN.get, PLACED),
    fj.Wrench(TIP, moment=lambda t: jnp.sin(9 * t)),
    fj.LinearActuator(HOOK, TIP, force=1.0),
    fj.forces.Payload(TIP, 0.4, begin=0.3, end=0.6),
    fj.PDController(1.0, 1.0, 1.0, fj.CircleTask()),
)


def test_lines_are_those_of_the_drawing():
    motion = swinging()
    g = drawing.geometry(ARM, motion.q, motion.ts, DRAWN)
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
    _, data = show(LINKAGE, failed)
    titles = [motion["title"] for motion in data["motions"]]
    assert titles == ["member 0", "member 1", "member 2"]
    rows = [array(data, motion["t"]).size for motion in data["motions"]]
    assert rows == [5, 3, 5]
    arms = {"a": LINKAGE, "b": ARM}
    spring = fj.SpringDamper(HOOK, TIP, stiffness=1, damping=0)
    _, data = show(arms, {"a": SOLUTION, "b": swinging(7)}, {"a": (), "b": (spring,)})
    first, second = data["motions"]
    assert (first["title"], first["kinds"], second["kinds"]) == ("a", "RRR", "RPR")
    assert [m["lines"][0][0] for m in (first, second)] == ["link 0", "spring 0"]


def test_a_batch_of_arms_belongs_to_its_motions(show):
    scaled = [LINKAGE.replace(length=k * LINKAGE.length) for k in (1, 2, 3)]
    arms = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scaled)
    _, data = show(arms, BATCH)
    assert [motion["length"][1] for motion in data["motions"]] == [1, 2, 3]


def held():
    """A motion whose slide rests on its lower stop from 0.2 to 0.6 s, and that ends."""
    times = np.array([0.2, 0.6, np.nan])
    kinds, modes = np.array([3, 4, 0]), np.zeros((101, 3))
    modes[20:60, 1] = 2
    q = swinging().q.at[81:].set(np.nan)
    return eqx.tree_at(
        lambda s: (s.q, s.modes, s.taken, s.events, s.end), swinging(),
        (q, modes, np.zeros(101), Events(times, np.array([2, 2, 2]), kinds, 2),
         End(np.array(0.805), q[0], q[0], np.array(1))),
        is_leaf=lambda leaf: leaf is None,
    )  # fmt: skip


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


def test_payloads_and_resets_are_marked(show):
    reset = Events(np.array([0.5]), np.array([0]), np.array([8]), 1)
    motion = eqx.tree_at(
        lambda s: s.events, swinging(), reset, is_leaf=lambda leaf: leaf is None
    )
    load = fj.forces.Payload(TIP, 0.4, begin=0.3, end=0.6)
    there = fj.forces.Payload(TIP, 0.1, begin=0.0)  # from the start
    (shown,) = show(ARM, motion, (there, load))[1]["motions"]
    assert shown["events"] == [
        [0.3, "a payload is picked up"], [0.5, "the state is reset"],
        [0.6, "a payload is released"],
    ]  # fmt: skip


def test_forces_of_a_batch_are_refused():
    dampers = jax.vmap(fj.JointDamper)(jnp.ones((5, 3)))
    with pytest.raises(ValueError, match=r"^forces\[0\].* one set of forces\.$"):
        fj.view(LINKAGE, BATCH, (dampers,))


def test_a_failure_is_told(show):
    failed = eqx.tree_at(lambda s: s.q, SOLUTION, SOLUTION.q.at[3:].set(jnp.nan))
    failed = eqx.tree_at(lambda s: s.result, failed, diffrax.RESULTS.nonfinite)
    (shown,) = show(LINKAGE, failed)[1]["motions"]
    assert shown["ending"] == "not finite at 0.5 s"


def test_no_title_is_taken_for_the_page(show):
    title = "</script><!--data--><b>\"'&"
    view, data = show(LINKAGE, {title: SOLUTION})
    assert data["motions"][0]["title"] == title
    assert "<b>\"'" not in view.html and view.html.count("</script>") == 2


def test_a_notebook_shows_the_page(show):
    view, _ = show(LINKAGE, SOLUTION)
    assert repr(view) == f"View(path={view.path!r})"
    frame = view._repr_html_()
    assert frame.count('"') == frame.count('="') * 2  # the page ends no attribute
    assert "<script" not in frame and frame.startswith("<iframe")


def test_scenes_stand_for_linkages_and_their_own_forces(show):
    motion, forces = swinging(), [(fj.JointDamper(k),) for k in (1.0, 2.0)]
    before, after = (fj.Scene(ARM, REST, own, 1.0) for own in forces)
    assert show(before, motion)[1] == show(ARM, motion, forces[0])[1]
    scenes = {"before": before, "after": after}
    _, data = show(scenes, dict.fromkeys(scenes, motion))
    efforts = [
        [array(data, s["y"]) for s in shown["series"] if s["panel"] == "effort"]
        for shown in data["motions"]
    ]
    np.testing.assert_array_equal(efforts[1], 2 * np.stack(efforts[0]))
    # One dictionary may hold both kinds.
    arms, motions = scenes | {"free": ARM}, dict.fromkeys((*scenes, "free"), motion)
    free = show(arms, motions)[1]["motions"][2]
    assert free["title"] == "free"
    assert "effort" not in {s["panel"] for s in free["series"]}


def test_the_title_of_the_page_names_the_motions(show):
    titles = ("a <i>", "b", "c", "d", "e")
    view, _ = show(LINKAGE, dict.fromkeys(titles, SOLUTION))
    assert "<title>a &lt;i&gt;, b, c, d, e</title>" in view.html
    view, _ = show(LINKAGE, dict.fromkeys((*titles, "f"), SOLUTION))
    assert "<title>a &lt;i&gt;, b, c, d, e, ...</title>" in view.html
    assert "<title>RRR arm</title>" in show(LINKAGE, SOLUTION)[0].html


def test_sampled_motions_come_with_their_control(show):
    """Its efforts are those that acted."""
    acting = np.arange(15.0).reshape(5, 3)
    motion = eqx.tree_at(
        lambda s: (s.tau, s.acting), SOLUTION, (acting, acting),
        is_leaf=lambda leaf: leaf is None,
    )  # fmt: skip
    control = lambda t, q, qd, linkage: -2.0 * qd
    (shown,) = (data := show(LINKAGE, motion, (control,))[1])["motions"]
    efforts = [array(data, s["y"]) for s in shown["series"] if s["panel"] == "effort"]
    np.testing.assert_array_equal(np.stack(efforts, axis=1), acting)


def test_what_messages_leave_out_is_told():
    with pytest.raises(ValueError, match=r"got Scene\(linkage=.{183}\.{3}\.$"):
        fj.view(fj.Scene(LINKAGE, REST, (), 1.0), {"a": SOLUTION})
