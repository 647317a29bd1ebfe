"""The fuzzer on 220 cases, always the same; and cases found by longer runs."""

import math

import pytest

from hard import fuzz
from hard.fuzz_report import Report
from hard.oracle import Arm
from hard.random_scenes import Scene

ZERO = (0.0, 0.0, 0.0)
POINTS = ((0.0, 0.0),) * 3


def scene(arm, q, **changes):
    usual = dict(qd=ZERO, tau=ZERO, junk=0.0, damping=ZERO, pace=1.0, t0=0.0)
    return Scene(arm, q, **{**usual, **changes})


@pytest.mark.slow
@pytest.mark.parametrize("kind, cases", [("accelerations", 120), ("motions", 100)])
def test_whatever_is_drawn_has_a_named_outcome(kind, cases):
    report = Report()
    fuzz.run(kind, cases, report)
    assert not report.failures
    assert report.outcomes.total() >= cases


FOUND = {
    # Gaussian elimination of badly scaled rows moved fictitious joints.
    "masked: a slide 100 m out": (
        "accelerations",
        scene(
            Arm(
                "RPR", (0.0,) * 4, POINTS, (1.0,) * 3, (1.0, 1.0, 1e3), ZERO, 0.0, 9.81
            ),
            q=(math.pi / 2, 10**1.5, 0.0),
            tau=(0.0, 0.0, 1e4),
        ),
    ),
    # The same fault: an error 40 times that of rounding the terms.
    "masked: an inertia of 1e6": (
        "accelerations",
        scene(
            Arm(
                "PRP",
                length=(1.0,) * 4,
                com=(
                    (-12.906900973580951, 0.0025936692501958357),
                    (1.0, 1.0),
                    (1.0, 1.0),
                ),
                mass=(1.393936464348783, 1.0, 1.0),
                inertia=(0.0, 984651.1691307587, 1.0),
                locked=(1.0, 0.013937144316940648, 0.0),
                base_angle=-math.pi / 2,
                gravity=1.0023052380778996,
            ),
            q=(1.0, 1.0, 1.0),
            tau=(212.25726232617592, 1.0, -720006.8483329134),
        ),
    ),
    # Two pivot ratios of 1e-8 lose 16 digits together; each alone indicates 8.
    "two small pivots": (
        "accelerations",
        scene(
            Arm(
                "PRR",
                length=(0.0, 0.3, 1.0, 1.0),
                com=((0.0, 0.0), (0.0, 0.0), (1.0, 0.0)),
                mass=(1e-8, 0.0, 1.0),
                inertia=ZERO,
                locked=ZERO,
                base_angle=-1.5,
                gravity=9.81,
            ),
            q=(0.2, 1.4, 1e-4),
            qd=(0.1, 0.2, 0.3),
            tau=(1.0, 2.0, 3.0),
        ),
    ),
    # A joint without any inertia: its ratio was 0 / 0, which was not reported.
    "a mass at the joint": (
        "accelerations",
        scene(
            Arm(
                "RRP",
                length=(-53.251838798845725, 1.0, 0.0, 1.0000000001399305),
                com=((0.0, -1.0), (1.0, -1.0), (1.0, 0.0)),
                mass=(1.0, 0.0, 1.0),
                inertia=(1.0, 0.0, 0.0),
                locked=(0.0, 0.0, -1.5707963267948966),
                base_angle=-3.141592653589793,
                gravity=1.0,
            ),
            q=(-79.43282347242814, -1e-12, 1.0),
        ),
    ),
    # Singular at the start: the outcome must name this, not the step size.
    "singular at the start": (
        "motions",
        scene(
            Arm(
                "PRP",
                length=(-1.0, 1.0, 0.4, 1.0),
                com=((0.0, -16.0), (-1.7, 0.02), (0.0, 0.01)),
                mass=(0.0, 0.0, 1.0),
                inertia=(0.0, 0.002, 0.008),
                locked=ZERO,
                base_angle=0.0,
                gravity=9.81,
            ),
            q=(1.0, 1e-12, 3.0),
            qd=(1.0, 0.0, 0.0),
            tau=(-1.0, 1.0, 0.0),
        ),
    ),
    # A coordinate that overflowed to infinity made the next step NaN, for ever.
    "damping of 1e6 on an inertia of 1e-3": (
        "motions",
        scene(
            Arm(
                "RRR",
                length=(0.0, 1.0, 1.0, 1.0),
                com=((0.5, 0.0),) * 3,
                mass=(1.0, 1.0, 0.0),
                inertia=(1.0, 1.0, 1e-3),
                locked=ZERO,
                base_angle=0.0,
                gravity=0.0,
            ),
            q=ZERO,
            tau=(0.0, 1.0, 0.0),
            damping=(0.0, 0.0, 1e6),
        ),
    ),
}


@pytest.mark.parametrize("case", FOUND)
def test_what_was_found_has_a_named_outcome(case):
    fuzz.check(*FOUND[case], Report())
