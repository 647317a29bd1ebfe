"""Copies with other numbers, by `replace`, are checked as new ones are."""

import equinox as eqx
import pytest
from elements import ALL

import fdof_jax as fj

EIGHT = fj.references.FigureEight([1.6, 0.4], [0.5, 0.3])


@pytest.mark.parametrize(
    "part",
    [
        *ALL.values(),
        fj.CircleTask(),
        fj.TipTask(EIGHT, fj.references.Laps(period=4.0)),
        fj.references.Spline([[0, 0], [1, 1], [2, 0]], closed=True),
        fj.Wrench(fj.Point(1), force=[1, 0], follows=True),
        fj.simulation.PrescribedMotion((1, 3), lambda t, linkage: 0),
    ],
    ids=lambda part: type(part).__name__,
)
def test_a_copy_is_equal_in_values_and_structure(part):
    assert eqx.tree_equal(part.replace(), part, typematch=True)


def test_a_copy_has_other_numbers_of_an_element():
    spring = fj.SpringDamper(fj.Point(0), fj.Point(1, 1), stiffness=2, damping=3)
    stiff = spring.__replace__(stiffness=4.0, one_sided="cable")  # by `copy.replace`
    assert (float(stiff.stiffness), float(stiff.damping), int(stiff.side)) == (4, 3, 1)
    assert stiff.replace(one_sided=False, stiffness=2.0).side is None
    pid = fj.control.PIDController(1.0, 2.0, 3.0, 4.0, fj.CircleTask())
    assert float(pid.replace(kp=5.0).pd.kp) == 5
    for values, words in [
        ({"stiffness": -1}, "^stiffness: expected .* at least 0"),
        ({"ends": None}, "^ends: expected one of a, b, .*, one_sided, got another"),
        ({300 * "z": 1}, r"^z{197}\.\.\.: expected one of"),
    ]:
        with pytest.raises(ValueError, match=words):
            stiff.replace(**values)


def test_a_copy_needs_the_arguments_of_its_constructor():
    class Doubled(fj.Element):
        gain: fj.Values = fj.field(unit="N m")

        def __init__(self, half):
            self.gain = 2 * half

        def __call__(self, t, q, qd, linkage):
            return self.gain * q

    with pytest.raises(TypeError, match="^Doubled: .* `arguments`, .* no fields: half"):
        Doubled(1.0).replace(half=2.0)
