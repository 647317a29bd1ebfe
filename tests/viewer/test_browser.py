"""The page of `view` in a browser: it plays, jumps, zooms, and draws in its place."""

import numpy as np
import pytest
from browser import DRIVER, PROGRAM, browser
from figures import made_up, make_linkage
from test_view import held

import fdof_jax as fj

TS = np.linspace(0, 2, 101)
Q = np.stack([0.3 + TS, 0.4 + 0.2 * np.sin(3 * TS), 0.5 - TS], axis=1)
ARM, MOTION, SLOW = make_linkage("RPR"), made_up(TS, Q), made_up(TS, Q / 2)
HERE = bool(PROGRAM and DRIVER)
NEEDS = pytest.mark.skipif(not HERE, reason="needs Chromium and chromedriver")
pytestmark = [pytest.mark.slow, NEEDS]


@pytest.fixture(scope="module")
def page():
    with browser() as page:
        page.size(1280, 800)
        yield page


@pytest.fixture
def opened(page, tmp_path):
    """Opens motions; checks that the console stays empty."""

    def of(motions, forces=()):
        page.open(fj.view(ARM, motions, forces, tmp_path / "motion.html").path)
        page.scheme("light")
        return page

    yield of
    assert page.post("/se/log", type="browser") == []


@pytest.fixture
def one(opened):
    spring = fj.SpringDamper(fj.Point(0, 1, 1), fj.Point(2, 1), stiffness=5, damping=1)
    return opened(MOTION, (spring,))


def of(page, name, property="value"):
    script = "return document.getElementById(arguments[0])[arguments[1]]"
    return page.run(script, name, property)


def time_of(page):
    return float(of(page, "time"))


def texts(page, places):
    every = "document.querySelectorAll(arguments[0])"
    return page.run(f"return Array.from({every}, one => one.textContent)", places)


def scrub(page, time):
    slider = "const slider = document.getElementById('time');"
    moved = "slider.value = arguments[0]; slider.dispatchEvent(new Event('input'))"
    page.run(slider + moved, float(time))
    page.drawn()


def place(page, q):
    """Returns where the page draws the tip at positions, in pixels of the window."""
    scale, x, y = page.run(
        "const stage = document.getElementById('stage');"
        "const box = stage.getBoundingClientRect();"
        "const [s, x, y] = JSON.parse(stage.dataset.transform);"
        "return [s, box.x + x, box.y + y]"
    )
    point = np.asarray(fj.tip_position(ARM, q))
    return np.array([x + scale * point[0], y - scale * point[1]])


DRAWN = """
const canvas = document.getElementById("front"), box = canvas.getBoundingClientRect();
const {width, height} = canvas, [left, top, color] = arguments;
const probe = document.body.appendChild(document.createElement("i"));
probe.style.color = `var(--${color})`;
const wanted = getComputedStyle(probe).color.match(/\\d+/g).map(Number);
probe.remove();
const often = {willReadFrequently: true};
const copy = new OffscreenCanvas(width, height).getContext("2d", often);
copy.drawImage(canvas, 0, 0);
const {data} = copy.getImageData(0, 0, width, height);
let count = 0, x = 0, y = 0;
for (let k = 0; k < width * height; k++) {
  const u = box.x + k % width + 0.5, v = box.y + Math.floor(k / width) + 0.5;
  const same = c => Math.abs(data[4 * k + c] - wanted[c]) < 3;
  const near = Math.max(Math.abs(u - left), Math.abs(v - top)) < 11.5;
  if (near && same(0) && same(1) && same(2) && data[4 * k + 3] > 250) {
    count++; x += u; y += v;
  }
}
return [x / count, y / count];
"""


def check_tip(page, q, color="tip"):
    """Checks where the tip's mark is, which alone has its colour near there."""
    tip = place(page, q)
    drawn = np.array(page.run(DRAWN, *map(float, tip), color))
    assert np.abs(drawn - tip).max() < 1


def test_the_scrubber_moves_the_tip_to_its_place(one):
    one.press("t", "t")  # without the path, which has the tip's colour
    for size in (360, 740), (1280, 800):
        one.size(*size)
        for time, q in ((0, Q[0]), (TS[37], Q[37]), (1.01, (Q[50] + Q[51]) / 2)):
            scrub(one, time)
            check_tip(one, q)
        assert one.run("return document.documentElement.scrollWidth") == size[0]


def test_it_plays_and_stops_at_the_end(one):
    one.press("l", *["ArrowDown"] * 3, " ")  # slowly, and not again from the start
    seen = [time_of(one) for _ in range(3) if one.drawn() is None]
    assert 0 < seen[0] < seen[1] < seen[2] < 2
    assert of(one, "play", "ariaLabel") == "pause"
    scrub(one, 1.99)
    one.run(
        "const play = document.getElementById('play');"
        "return new Promise(done => { const wait = () => play.ariaLabel === 'play' ?"
        " done(1) : setTimeout(wait, 20); wait(); })"
    )
    assert time_of(one) == 2


def test_keys_and_clicks_on_a_curve_jump(one):
    one.press("ArrowRight", "ArrowRight", "ArrowRight", "ArrowLeft")
    assert time_of(one) == pytest.approx(TS[2], abs=1e-6)
    one.press("End", "ArrowUp")
    assert time_of(one) == 2 and of(one, "speed") == "2"
    one.press("Home")
    assert time_of(one) == 0
    box = "const box = document.querySelector('.plot').getBoundingClientRect();"
    x, y, width = one.run(box + "return [box.x, box.y + 40, box.width]")
    for kind in ("mousePressed", "mouseReleased"):
        one.mouse(kind, x + 52 + (width - 60) / 2, y)  # the middle, between margins
    assert time_of(one) == pytest.approx(1, abs=0.01)
    assert float(texts(one, ".key u")[0]) == pytest.approx(Q[50, 0], abs=0.02)


def test_the_wheel_zooms_about_the_mouse_and_drags_move(one):
    size = lambda: np.linalg.norm(place(one, Q[0]) - place(one, Q[9]))
    before, at_first = place(one, Q[0]), size()
    one.mouse("mouseWheel", *before, deltaX=0, deltaY=-100)
    np.testing.assert_allclose(place(one, Q[0]), before, atol=0.5)
    assert size() > 1.1 * at_first
    one.mouse("mousePressed", 300, 300)
    for step in (10, 20, 30):
        one.mouse("mouseMoved", 300 + step, 300 - step)
    one.mouse("mouseReleased", 330, 270)
    np.testing.assert_allclose(place(one, Q[0]), before + [30, -30], atol=0.5)
    one.press("0")
    assert size() == pytest.approx(at_first)


def test_motions_are_laid_over_each_other_or_side_by_side(opened):
    titles = ["before <i>", "after"]
    two = opened(dict(zip(titles, (MOTION, SLOW))))
    two.press("t", "t")
    for _ in range(2):
        assert texts(two, "#legend span") == titles
        for title, motion, color in zip(titles, (MOTION, SLOW), ("tip", "m1")):
            assert texts(two, "#legend span.full") == [title]
            scrub(two, TS[60])
            check_tip(two, motion.q[60], color)
            two.press("]")
        two.press("s")
    assert of(two, "side", "ariaPressed") == "false"


def test_light_and_dark_differ(one):
    color = "return getComputedStyle(document.body).backgroundColor"
    light = one.run(color)
    one.scheme("dark")
    assert one.run(color) != light
    one.press("d")
    assert one.run(color) == light


def test_events_are_listed_and_what_holds_a_joint_is_told(opened):
    page = opened(held())
    rests = ["0.200 sP2 rests on its stop", "0.600 sP2 leaves its stop"]
    assert texts(page, "#events li")[:2] == rests
    assert len(texts(page, "#marks i")) == 3 and "".join(texts(page, ".key em")) == ""
    page.press(".")
    assert time_of(page) == pytest.approx(0.2, abs=1e-6)
    assert "".join(texts(page, ".key em")) == "lower stop"


def test_where_scripts_are_off_a_picture_stands(page, tmp_path):
    off, still = "Emulation.setScriptExecutionDisabled", tmp_path / "still.html"
    width = "document.querySelector('{}').clientWidth"
    both = f"[{width.format('.still svg')}, {width.format('main')}]"
    page.devtools(off, value=True)
    try:
        page.open(fj.view(ARM, MOTION, path=still).path)
        found = page.devtools("Runtime.evaluate", returnByValue=True, expression=both)
        wide, none = found["result"]["value"]
        assert wide > 600 and none == 0
    finally:
        page.devtools(off, value=False)
