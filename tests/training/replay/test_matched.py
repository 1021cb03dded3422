"""How exact a reference is, by matched scans: on a log whose truth, and whose reference's errors, are known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from slam.geometry import compose
from slam.logs import ScanLog, open_log
from slam.metrics.measures import nees_pose, nees_pose_invariant
from slam.metrics.relations import local_relations
from tests.slam.logs.scans_on_disk import carmen_lines, drive, put_lines
from training.replay.matched import (
    error_of_reference,
    errors,
    matched_relations,
    nees_with_reference,
    start_as_matched,
)

SCANS = 60
SIGMA = np.array([0.02, 0.02, 0.008])


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> ScanLog:
    path = tmp_path_factory.mktemp("matched") / "room.log"
    put_lines(path, carmen_lines(SCANS, kind="gfs2log"))
    found = open_log(path)
    assert isinstance(found, ScanLog)
    return found


def test_scans_bear_witness_to_the_truth_and_tell_the_references_error(log: ScanLog) -> None:
    true = drive(SCANS)[0]
    rng = np.random.default_rng(1)
    reference = true + SIGMA * rng.standard_normal(true.shape)
    reference[0] += [0.12, 0.0, 0.0]  # one that is far off: the first
    matched = matched_relations(log, np.arange(SCANS), reference, local_relations(SCANS, steps=(1, 2, 3)))
    assert len(matched.pairs) > 0.5 * 3 * SCANS
    off = errors(matched, true)
    assert np.hypot(off[:, 0], off[:, 1]).mean() < 0.005 and np.abs(off[:, 2]).mean() < 0.003
    metres, rad = error_of_reference(matched, reference)
    assert metres == pytest.approx(SIGMA[0], rel=0.25) and rad == pytest.approx(SIGMA[2], rel=0.25)
    start, of = start_as_matched(matched, reference)
    assert of == 3 and np.abs(start - true[0])[:2].max() < 0.05


def test_nees_owns_to_the_reference_at_both_ends() -> None:
    rng = np.random.default_rng(2)
    way = [np.zeros(3)]
    for _ in range(30):
        way.append(compose(way[-1], np.array([0.5, 0.0, 0.1])))
    true = np.array(way)
    values = []
    for _ in range(300):
        own = SIGMA * rng.standard_normal(true.shape)
        reference = true + own
        estimates = np.array([compose(reference[0], pose) for pose in true])  # exact, from where it was said to be
        covs = np.zeros((len(true), 3, 3))
        sigma = float(SIGMA[0]), float(SIGMA[2])
        values.append(nees_with_reference(estimates, covs, reference, reference[0], sigma=sigma, of=1)[1:] / 3)
    assert np.mean(values) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("form", [nees_pose, nees_pose_invariant])
def test_what_the_reference_errs_makes_no_nees_larger(form: Callable[..., float]) -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        estimate, reference = rng.normal(size=3), rng.normal(size=3)
        cov, first = np.cov(rng.normal(size=(3, 9))), np.zeros(3)
        with_own = nees_with_reference(
            np.array([first, estimate]), np.array([cov, cov]), np.array([first, reference]), first,
            sigma=(0.1, 0.05), of=1, form=form,
        )  # fmt: skip
        assert with_own[1] <= form(estimate, cov, reference)
