"""The page of `view` in a browser: it plays, jumps, zooms, and draws in its place."""

import numpy as np
import pytest
from browser import DRIVER, PROGRAM, browser
from figures import made_up, make_linkage
from test_view import held

import fdof_jax as fj

TS = np.linspace(0, 2, 101)
Q = np.stack([0.3 + TS, 0.4 + 0.2 * np.sin(3 * TS), 0.5 - TS], axis=1)
ARM, MOTION = make_linkage("RPR"), made_up(TS, Q)
SLOW = made_up(TS, Q / 2)
TITLES = "before <i>", "after"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not (PROGRAM and DRIVER), reason="needs Chromium and chromedriver"
    ),
]


@pytest.fixture(scope="module")
def page():
    with browser() as page:
        page.size(1280, 800)
        yield page


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("views")


@pytest.fixture
def one(page, folder):
    spring = fj.SpringDamper(fj.Point(0, 1, 1), fj.Point(2, 1), stiffness=5, damping=1)
    page.open(fj.view(ARM, MOTION, (spring,), folder / "one.html").path)
    return shown(page)


@pytest.fixture
def two(page, folder):
    motions = dict(zip(TITLES, (MOTION, SLOW)))
    page.open(fj.view(ARM, motions, path=folder / "two.html").path)
    return shown(page)


def shown(page):
    page.scheme("light")
    return page


@pytest.fixture(autouse=True)
def no_error(page):
    yield
    assert page.console() == []


def time_of(page):
    return page.run("return +document.getElementById('time').value")


def scrub(page, time):
    page.run(
        "const slider = document.getElementById('time'); slider.value = arguments[0];"
        "slider.dispatchEvent(new Event('input'))",
        float(time),
    )
    page.drawn()


def place(page, point):
    """Where the page draws a point [m], in pixels of the window."""
    scale, x, y = page.run(
        "const stage = document.getElementById('stage');"
        "const box = stage.getBoundingClientRect();"
        "const [s, x, y] = JSON.parse(stage.dataset.transform);"
        "return [s, box.x + x, box.y + y]"
    )
    return np.array([x + scale * point[0], y - scale * point[1]])


def tip_drawn(page, near, color="tip"):
    """Middle of the tip's mark in the window, which alone has its colour near there."""
    return np.array(
        page.run(
            """
const canvas = document.getElementById("front"), box = canvas.getBoundingClientRect();
const {width, height} = canvas;
const probe = document.body.appendChild(document.createElement("i"));
const [left, top, color] = arguments;
probe.style.color = `var(--${color})`;
const wanted = getComputedStyle(probe).color.match(/\\d+/g).map(Number);
probe.remove();
const often = {willReadFrequently: true};
const copy = new OffscreenCanvas(width, height).getContext("2d", often);
copy.drawImage(canvas, 0, 0);
const {data} = copy.getImageData(0, 0, width, height);
let count = 0, x = 0, y = 0;
for (let k = 0; k < width * height; k++) {
  const u = k % width + 0.5, v = Math.floor(k / width) + 0.5;
  const same = c => Math.abs(data[4 * k + c] - wanted[c]) < 3;
  const near = Math.max(Math.abs(box.x + u - left), Math.abs(box.y + v - top)) < 11.5;
  if (near && same(0) && same(1) && same(2) && data[4 * k + 3] > 250) {
    count++; x += u; y += v;
  }
}
return [box.x + x / count, box.y + y / count];
""",
            *map(float, near), color,
        )
    )  # fmt: skip


@pytest.mark.parametrize("size", [(1280, 800), (360, 740)])
def test_the_scrubber_moves_the_tip_to_its_place(one, size):
    one.size(*size)
    one.press("t", "t")  # without the path, which has the tip's colour
    for row in (0, 37, 100):
        scrub(one, TS[row])
        tip = place(one, np.asarray(fj.tip_position(ARM, Q[row])))
        assert np.abs(tip_drawn(one, tip) - tip).max() < 1
    scrub(one, (TS[50] + TS[51]) / 2)
    tip = place(one, np.asarray(fj.tip_position(ARM, (Q[50] + Q[51]) / 2)))
    assert np.abs(tip_drawn(one, tip) - tip).max() < 1
    assert one.run("return document.documentElement.scrollWidth") == size[0]
    one.size(1280, 800)


def test_it_plays_and_stops_at_the_end(one):
    one.press("l")  # not again from the start
    one.press(" ")
    seen = [time_of(one) for _ in range(3) if one.drawn() is None]
    assert 0 < seen[0] < seen[1] < seen[2] < 2
    assert one.run("return document.getElementById('play').ariaLabel") == "pause"
    scrub(one, 1.99)
    one.run(
        "const play = document.getElementById('play');"
        "return new Promise(done => { const wait = () => play.ariaLabel === 'play' ?"
        " done(1) : setTimeout(wait, 20); wait(); })"
    )
    assert time_of(one) == 2


def test_keys_step_from_row_to_row(one):
    one.press("ArrowRight", "ArrowRight", "ArrowRight", "ArrowLeft")
    assert time_of(one) == pytest.approx(TS[2], abs=1e-6)
    one.press("End", "ArrowUp")
    assert time_of(one) == 2
    assert one.run("return document.getElementById('speed').value") == "2"
    one.press("Home")
    assert time_of(one) == 0


def test_a_click_on_a_curve_jumps_there(one):
    x, y, width = one.run(
        "const box = document.querySelector('.plot').getBoundingClientRect();"
        "return [box.x, box.y + 40, box.width]"
    )
    middle = x + 52 + (width - 60) / 2  # between the margins
    for kind in ("mousePressed", "mouseReleased"):
        one.mouse(kind, middle, y)
    one.drawn()
    assert time_of(one) == pytest.approx(1, abs=0.01)
    key = one.run("return document.querySelector('.key u').textContent")
    assert float(key) == pytest.approx(Q[50, 0], abs=0.02)


def test_the_wheel_zooms_about_the_mouse_and_drags_move(one):
    tip = np.asarray(fj.tip_position(ARM, Q[0]))
    before = place(one, tip)
    scale = place(one, tip + [1, 0])[0] - before[0]
    one.mouse("mouseWheel", *before, deltaX=0, deltaY=-100)
    one.drawn()
    np.testing.assert_allclose(place(one, tip), before, atol=0.5)
    assert place(one, tip + [1, 0])[0] - before[0] > 1.1 * scale
    one.mouse("mousePressed", 300, 300)
    for step in (10, 20, 30):
        one.mouse("mouseMoved", 300 + step, 300 - step)
    one.mouse("mouseReleased", 330, 270)
    one.drawn()
    np.testing.assert_allclose(place(one, tip), before + [30, -30], atol=0.5)
    one.press("0")
    assert place(one, tip + [1, 0])[0] - place(one, tip)[0] == pytest.approx(scale)


def test_motions_are_laid_over_each_other_or_side_by_side(two):
    entries = (
        "return Array.from(document.querySelectorAll('#legend span'), "
        "one => [one.textContent, one.className])"
    )
    two.press("t", "t")
    for _ in range(2):
        for title, motion, color in zip(TITLES, (MOTION, SLOW), ("tip", "m1")):
            assert two.run(entries) == [
                [one, "full" if one == title else ""] for one in TITLES
            ]
            scrub(two, TS[60])
            tip = place(two, np.asarray(fj.tip_position(ARM, motion.q[60])))
            assert np.abs(tip_drawn(two, tip, color) - tip).max() < 1
            two.press("]")
        two.press("s")
    assert two.run("return document.getElementById('side').ariaPressed") == "false"


def test_light_and_dark_differ(one):
    color = "return getComputedStyle(document.body).backgroundColor"
    light = one.run(color)
    one.scheme("dark")
    assert one.run(color) != light
    one.press("d")
    assert one.run(color) == light


def test_events_are_listed_and_what_holds_a_joint_is_told(page, folder):
    page.open(fj.view(ARM, held(), path=folder / "held.html").path)
    shown(page)
    texts = lambda of: page.run(
        "const found = document.querySelectorAll(arguments[0]);"
        "return Array.from(found, one => one.textContent)",
        of,
    )
    assert texts("#events li")[:2] == [
        "0.200 sP2 rests on its stop", "0.600 sP2 leaves its stop"
    ]  # fmt: skip
    assert page.run("return document.querySelectorAll('#marks i').length") == 3
    assert "".join(texts(".key em")) == ""
    page.press(".")
    assert time_of(page) == pytest.approx(0.2, abs=1e-6)
    assert "".join(texts(".key em")) == "lower stop"


def test_where_scripts_are_off_a_picture_stands(page, folder):
    page.devtools("Emulation.setScriptExecutionDisabled", value=True)
    try:
        page.open(fj.view(ARM, MOTION, path=folder / "still.html").path)
        found = page.devtools(
            "Runtime.evaluate", returnByValue=True,
            expression="[document.querySelector('.still svg').clientWidth, "
            "document.querySelector('main').clientWidth]",
        )  # fmt: skip
        wide, none = found["result"]["value"]
        assert wide > 600 and none == 0
    finally:
        page.devtools("Emulation.setScriptExecutionDisabled", value=False)
