"""Sliders: the effect of a move, which compiles nothing, and messages on failures."""

import subprocess
import sys
from io import BytesIO

import matplotlib.pyplot as plt
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax import scenes
from fdof_jax.pictures.interactive import sliders
from fdof_jax.simulation import prescribed
from fdof_jax.tuning.losses import with_gains

CIRCLES = fj.tuning.circle_scenes()
CONTROLLER = CIRCLES["RRR"].forces[0]
STIFF = with_gains(CIRCLES["RRR"], np.full((2, 3), 1e9))


class Box:
    """The box of sliders, with its parts by their labels."""

    def __init__(self, *arguments):
        controls, (self.image, self.words) = [
            part.children for part in sliders(*arguments).children
        ]
        named = {getattr(part, "description", ""): part for part in controls}
        self.parts = {name: part for name, part in named.items() if name}

    def move(self, **values):
        for name, value in values.items():
            self.parts[name.replace("_", " ")].value = value
        return self.pixels

    @property
    def pixels(self):
        return plt.imread(BytesIO(self.image.value), format="png")


@pytest.fixture(scope="module")
def all_arms():
    plt.close("all")  # figures of other tests
    return Box({**CIRCLES, "stiff": STIFF})


@pytest.fixture
def box(all_arms):
    """Returns the same box for all tests, so that only its first motion is compiled."""
    for part in all_arms.parts.values():
        if hasattr(part, "min"):
            part.value = 1.0
    all_arms.move(arm="RRR")
    return all_arms


def test_every_slider_changes_picture_and_words(box):
    for name in (
        "link 1",
        "link 2",
        "link 3",
        "kp 1",
        "kp 2",
        "kp 3",
        "kd 1",
        "kd 2",
        "kd 3",
    ):
        before, words = box.pixels, box.words.value
        after = box.move(**{name: 1.2})
        assert after.shape == before.shape
        assert np.abs(after - before).max() > 0.5, name
        assert box.words.value != words, name
    assert "600 N m/rad" in box.words.value and "link 2: 0.96 m" in box.words.value


@pytest.mark.slow
def test_the_error_is_that_of_a_simulation(box):
    box.move(kp_1=2.0)
    gains = np.stack([CONTROLLER.kp, CONTROLLER.kd])
    gains[0, 0] *= 2
    scene = with_gains(CIRCLES["RRR"], gains)
    ts = np.linspace(0, 4, 201)
    solution = fj.simulate(scene.linkage, scene.state0, ts, scene.forces)
    rms = np.sqrt((np.asarray(fj.tuning.tip_errors(scene, solution)) ** 2).sum())
    assert f"rms {1e3 * rms:.3g} mm" in box.words.value


def test_nothing_is_compiled_after_the_first_picture(box, monkeypatch):
    monkeypatch.setattr(prescribed, "FREE", None)  # no second trace
    shown = {name: box.move(arm=name, link_1=1.1).tobytes() for name in fj.TOPOLOGIES}
    assert len(set(shown.values())) == 7


def test_choosing_an_arm_keeps_the_sliders(box):
    box.move(link_1=1.1, kp_1=2.0, arm="PPR")
    assert "link 1: 1.1 m" in box.words.value and "4000 N/m" in box.words.value


def test_the_way_of_the_sliders_does_not_matter(box):
    """Checks that axes stored as pixels keep no trace of the previous picture."""
    there = box.move(arm="PRR", link_2=1.3)
    back = box.move(link_2=1.0)
    assert np.abs(there - back).max() > 0.5
    box.move(arm="RRR")
    np.testing.assert_array_equal(box.move(arm="PRR"), box.move(arm="PRR"))
    fresh = box.pixels
    box.move(kd_1=1.05)
    np.testing.assert_array_equal(box.move(kd_1=1.0), fresh)


def test_a_circle_out_of_reach_is_told_and_the_arm_still_drawn(box):
    before = box.pixels
    after = box.move(link_1=0.5, link_2=0.5)
    assert "out of the arm's reach</b> from 0.00 s" in box.words.value
    assert np.abs(after - before).max() > 0.5
    box.move(link_1=1.0, link_2=1.0)
    assert "Tip error: rms" in box.words.value


def test_a_motion_that_fails_is_told(box):
    box.move(arm="stiff")
    assert "out of steps" in box.words.value and "Ended at 0" in box.words.value


def test_a_slider_starts_on_one_of_its_steps(box):
    """The browser would otherwise move the slider."""
    for name, part in box.parts.items():
        if name.startswith("k"):
            steps = np.array([0 - part.min, part.max]) / part.step
        elif name.startswith("link"):
            steps = np.array([1 - part.min, part.max - 1]) / part.step
        else:
            continue
        np.testing.assert_allclose(steps, steps.round(), atol=1e-9)


def test_no_figure_is_left_to_be_shown_twice(box):
    assert not plt.get_fignums()


@pytest.mark.parametrize(
    "given, message",
    [
        ({}, "^scenes: expected"),
        (CIRCLES["RRR"], "^scenes: expected"),
        ({"a": 3}, r"^scenes\['a'\]: expected a Scene"),
        ({"a": scenes.fig5()}, "^scene: expected exactly one PDController"),
        (
            {"a": CIRCLES["RRR"]._replace(
                forces=(fj.PDController(1, 1, 1, lambda t, linkage: None),)
            )},
            r"^scenes\['a'\]: expected a controller of a task with a tip",
        ),
    ],
)  # fmt: skip
def test_malformed_scenes_are_named(given, message):
    with pytest.raises(ValueError, match=message):
        sliders(given)


def test_without_ipywidgets_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    with pytest.raises(ImportError, match=r"fdof_jax\[notebook\]"):
        sliders()


def test_importing_the_module_imports_no_ipywidgets():
    code = "import sys, fdof_jax; fdof_jax.interactive; print(*sys.modules)"
    command = [sys.executable, "-c", code]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    modules = run.stdout.split()
    assert "matplotlib" in modules and "ipywidgets" not in modules
