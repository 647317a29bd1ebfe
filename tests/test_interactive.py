"""Sliders: the effect of a move, which compiles nothing, and messages on failures."""

from base64 import b64encode
from io import BytesIO

import jax.numpy as jnp
import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pytest
from nbconvert import HTMLExporter

import fdof_jax as fj
from fdof_jax.pictures.interactive import _moved, sliders
from fdof_jax.simulation import formulation
from fdof_jax.tuning.losses import with_gains

CIRCLES = fj.scenes.circle_scenes()
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


@pytest.mark.slow
def test_every_slider_changes_picture_and_words(box):
    for name in (f"{kind} {k}" for kind in ("link", "kp", "kd") for k in (1, 2, 3)):
        before, words = box.pixels, box.words.value
        after = box.move(**{name: 1.2})
        assert after.shape == before.shape
        assert np.abs(after - before).max() > 0.5, name
        assert box.words.value != words, name
    assert "600 N m/rad" in box.words.value and "link 2: 0.96 m" in box.words.value
    assert not plt.get_fignums()  # a notebook would show a figure twice


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


@pytest.mark.slow
def test_an_exported_notebook_has_a_still_picture():
    box = sliders({"RRR": CIRCLES["RRR"]})
    code = nbformat.v4.new_code_cell("")
    data = box._repr_mimebundle_()
    code.outputs.append(nbformat.v4.new_output("display_data", data))
    page, _ = HTMLExporter().from_notebook_node(nbformat.v4.new_notebook(cells=[code]))
    assert "application/vnd.jupyter.widget-view+json" in data
    picture = box.children[1].children[0].value
    assert b64encode(picture).decode() in page


@pytest.mark.slow
def test_nothing_is_compiled_after_the_first_picture(box, monkeypatch):
    monkeypatch.setattr(formulation, "_TERMS", {})  # no second trace
    box.move(kp_1=2.0)
    shown = {name: box.move(arm=name, link_1=1.1).tobytes() for name in fj.TOPOLOGIES}
    assert len(set(shown.values())) == 7
    # The sliders keep their places.
    box.move(arm="PPR")
    assert "link 1: 1.1 m" in box.words.value and "4000 N/m" in box.words.value


@pytest.mark.slow
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


@pytest.mark.slow
def test_failures_are_told_and_the_arm_still_drawn(box):
    before = box.pixels
    after = box.move(link_1=0.5, link_2=0.5)
    assert "out of the arm's reach</b> from 0.00 s" in box.words.value
    assert np.abs(after - before).max() > 0.5
    box.move(link_1=1.0, link_2=1.0)
    assert "Tip error: rms" in box.words.value
    box.move(arm="stiff")
    assert "out of steps" in box.words.value and "Ended at 0" in box.words.value


@pytest.mark.slow
def test_a_slider_starts_on_one_of_its_steps(box):
    """The browser would otherwise move the slider."""
    for name, part in box.parts.items():
        if name == "arm":
            continue
        start = 0 if name.startswith("k") else 1  # factors of gains are logarithmic
        steps = np.array([start - part.min, part.max - start]) / part.step
        np.testing.assert_allclose(steps, steps.round(), atol=1e-9)
        np.testing.assert_allclose(part.max, 1.5 if start else np.log10(4))


def test_a_link_is_stretched_with_its_mass_centre():
    scene = CIRCLES["RRR"]
    scene = scene._replace(t1=jnp.asarray(scene.t1, float))  # as the sliders do
    arm = _moved(scene, jnp.array([1.2, 1, 1]), jnp.ones((2, 3))).scene.linkage
    np.testing.assert_allclose(arm.com[0], scene.linkage.com[0] * np.array([1.2, 1]))
    np.testing.assert_allclose(arm.length[1], 1.2 * scene.linkage.length[1])
