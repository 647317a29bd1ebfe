"""Identification raises errors for recordings and settings that it cannot use."""

import numpy as np
import pytest
from test_identification import FIRST, MIXED, TS

import fdof_jax as fj

SEEN = np.zeros((201, 3, 2))


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(scene_at=3), "scene_at: expected a callable"),
        (dict(scene_at=lambda p: p["mass"]), r"scene_at\(...\): expected a Scene"),
        (dict(scene_at=lambda p: p["weight"]), "start: expected a value for 'weight'"),
        (dict(start=[1.0]), "start: expected a dict"),
        (dict(start={}), "start: expected a dict"),
        (dict(start={1: 2.0}), "start: expected names"),
        (dict(start=FIRST | {"mass": np.nan}), r"start\['mass'\]: expected a real"),
        (dict(start=FIRST | {"mass": "heavy"}), r"start\['mass'\]: expected a real"),
        (dict(start=FIRST | {"mass": [[1], [2, 3]]}), r"start\['mass'\]: expected"),
        (dict(start=FIRST | {"offset": 0}), "scale: expected a size for 'offset'"),
        (dict(scale={"mass": 0}), r"scale\['mass'\]: expected a real number"),
        (dict(scale={"weight": 1}), "scale: expected a dict with names from"),
        (dict(bounds={"weight": (1, 2)}), "bounds: expected a dict with names from"),
        (dict(bounds={"mass": (1, 2)}), r"bounds\['mass'\]: expected the start betw"),
        (dict(bounds={"mass": 2}), r"bounds\['mass'\]: expected \(least, greatest\)"),
        (dict(ts=TS[::-1]), "ts: expected two or more increasing"),
        (dict(ts=TS[:1]), "ts: expected two or more increasing"),
        (dict(ts=TS[:, None]), "ts: expected an array of n"),
        (dict(observed="film"), "observed: expected an array of real numbers"),
        (dict(observed=SEEN + np.inf), "observed: expected finite"),
        (dict(observed=SEEN[:5]), "observed: expected a row for each of the 201"),
        (dict(observed=3.0), "observed: expected a row for each of the 201"),
        (dict(observed=SEEN[:, :2]), "observed: expected the shape"),
        (dict(observed=SEEN * np.nan), "observed: expected more readings than the 6"),
        (dict(observe=3), "observe: expected a callable"),
        (dict(noise=0), "noise: expected a real number"),
        (dict(noise=np.ones((4, 2))), "noise: expected one number, or an array that"),
        (dict(max_steps=0), "max_steps: expected a whole number"),
        (dict(report=3), "report: expected a callable"),
        (dict(scene_at=[MIXED, MIXED]), "observed: expected a recording for each"),
    ],
)
def test_malformed_arguments(changes, message):
    arguments = dict(scene_at=MIXED, start=FIRST, ts=TS, observed=SEEN) | changes
    with pytest.raises(ValueError, match=message):
        fj.fit(**arguments)


def test_malformed_batches():
    with pytest.raises(ValueError, match="observed: expected recordings"):
        fj.identification.fit_each(MIXED, FIRST, TS, 3.0)
    with pytest.raises(TypeError, match="tolerance: expected a keyword among observe,"):
        fj.identification.fit_each(MIXED, FIRST, TS, SEEN[None], tolerance=1e-3)
