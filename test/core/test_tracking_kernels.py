"""The compiled algebra of tracking against numpy, and the filter against its formulas."""

from itertools import islice

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from rcseg_core.compute.small import rotation
from rcseg_core.shapes.local_forms import LocalCylinder, LocalSphere
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.tracking import kernels, matching
from rcseg_core.tracking.columns import longer
from rcseg_core.tracking.fusion import NO_DRIFT, Filter, Related, in_fixed_frame, moved, relate
from rcseg_core.tracking.motion import estimate_motion
from rcseg_core.tracking.planes import FusedPlanes, Planes, forbid, fuse


def covariance(rng, q, size=1e-3):
    root = rng.normal(size=(q, q)) * size
    return root @ root.T + 1e-3 * size**2 * np.eye(q)


def random_pose(rng, tilt=3.0):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(rng.normal(size=3) * tilt).as_matrix()
    pose[:3, 3] = rng.normal(size=3)
    return pose


@pytest.mark.parametrize("q", [3, 4, 5])
def test_small_matrices_are_inverted_and_rooted(q):
    rng = np.random.default_rng(q)
    for _ in range(20):
        matrix = covariance(rng, q)
        root, out = np.empty((6, 5)), np.empty((6, 5))
        log_det = kernels.inverse(matrix, q, root, out)
        assert log_det == pytest.approx(np.linalg.slogdet(matrix)[1])
        np.testing.assert_allclose(out[:q, :q] @ matrix, np.eye(q), atol=1e-8)
        kernels.symmetric_root(matrix, q, root, np.empty((6, 5)), out)
        np.testing.assert_allclose(out[:q, :q] @ out[:q, :q], matrix, rtol=1e-9, atol=1e-18)
        np.testing.assert_allclose(out[:q, :q], out[:q, :q].T, atol=1e-15)
        d = rng.normal(size=q)
        assert kernels.chi_squared(d, matrix, q, np.empty((6, 5))) == pytest.approx(
            d @ np.linalg.solve(matrix, d)
        )
    assert kernels.cholesky(-np.eye(q), q, np.empty((6, 5))) == np.inf


def test_the_root_of_nothing_is_nothing():
    out = np.empty((6, 5))
    kernels.symmetric_root(np.zeros((3, 3)), 3, np.empty((6, 5)), np.empty((6, 5)), out)
    assert not out[:3, :3].any()


@pytest.mark.parametrize("size", [0.0, 1e-9, 5e-5, 2e-4, 1.0, 3.0, 6.5])
def test_a_vector_turns_by_its_length(size):
    axis = np.array([0.6, -0.48, 0.64])
    np.testing.assert_allclose(
        rotation(axis * size), Rotation.from_rotvec(axis * size).as_matrix(), atol=1e-15
    )


def test_a_mean_of_frames_is_what_its_formulas_say():
    """Frames of one view and one claim: random part over n, systematic part as it is."""
    rng = np.random.default_rng(3)
    random, systematic = covariance(rng, 3), covariance(rng, 3, 2e-4)
    first = LocalPlane(random_pose(rng), random, systematic)
    made = Filter(first)
    seen = [np.zeros(3)]
    for _ in range(24):
        seen.append(rng.multivariate_normal(np.zeros(3), random))
        made.add(Related(seen[-1], random, systematic))
    np.testing.assert_allclose(made.fused.covariance, random / 25, rtol=1e-6)
    np.testing.assert_allclose(made.fused.systematic, systematic, rtol=1e-6, atol=1e-14)
    told = relate(first, made.fused)
    np.testing.assert_allclose(told.difference, np.mean(seen, axis=0), rtol=1e-4, atol=1e-9)


def test_a_worse_frame_counts_for_nothing_and_a_better_one_begins_anew():
    eye = np.eye(3) * 1e-6
    made = Filter(LocalPlane(np.eye(4), eye, eye))
    before = made.fused.covariance + made.fused.systematic
    made.add(Related(np.full(3, 1e-3), eye, 100 * eye))
    assert np.linalg.det(made.fused.covariance + made.fused.systematic) <= np.linalg.det(before) * (1 + 1e-9)
    made.add(Related(np.full(3, 1e-3), 1e-4 * eye, 1e-4 * eye))
    assert np.linalg.det(made.fused.covariance + made.fused.systematic) <= np.linalg.det(2e-4 * eye) * (
        1 + 1e-9
    )


@pytest.mark.parametrize("kind", ["plane", "sphere", "cylinder"])
def test_what_is_related_is_told_by_small_steps(kind):
    """A shape that is changed by its free parameters has just these as its difference, wherever it is."""
    rng = np.random.default_rng(8)
    q = {"plane": 3, "sphere": 4, "cylinder": 5}[kind]
    for _ in range(10):
        pose, zero = random_pose(rng), np.zeros((q, q))
        random = covariance(rng, q)
        if kind == "plane":
            form = LocalPlane(pose, random, zero)
        elif kind == "sphere":
            form = LocalSphere(pose[:3, 3], 0.3, random, zero)
        else:
            form = LocalCylinder(pose, 0.2, random, zero)
        made = Filter(form)
        step = rng.normal(size=q) * 1e-4
        made.add(Related(2 * step, form.covariance, zero))  # the mean of 0 and this
        np.testing.assert_allclose(relate(form, made.fused).difference, step, rtol=1e-3, atol=1e-9)
        world = random_pose(rng)
        both = relate(moved(form, world), moved(made.fused, world))
        back = world[:3, :3] @ step[:3] if kind == "sphere" else step[:3]
        np.testing.assert_allclose(both.difference[:3], back, rtol=1e-3, atol=1e-9)


def test_a_plane_told_at_another_place_has_the_error_of_its_lever():
    """The same plane with its origin a metre along: its offset at the anchor varies with the tilt."""
    rng = np.random.default_rng(1)
    anchor = LocalPlane(np.eye(4), np.zeros((3, 3)), np.zeros((3, 3)))
    shifted = np.eye(4)
    shifted[0, 3], shifted[1, 3] = 1.0, -0.5
    random = covariance(rng, 3)
    told = relate(anchor, LocalPlane(shifted, random, np.zeros((3, 3))))
    np.testing.assert_allclose(told.difference, 0, atol=1e-15)
    # turned about x by a, about y by b, about its own origin, its height at the anchor is b x - a y
    table = np.array([[1, 0, 0], [0, 1, 0], [0.5, 1.0, 1.0]])
    np.testing.assert_allclose(told.random, table @ random @ table.T, rtol=1e-9)
    assert relate(anchor, LocalPlane(np.diag([1.0, -1, -1, 1]), random, random)) is None


@pytest.mark.parametrize("kind", ["plane", "sphere", "cylinder"])
def test_what_motions_add_is_that_of_shapes_that_are_moved_by_chance(kind):
    """Shapes moved by draws of the motion's error, about the sensor, spread as the filter says."""
    rng = np.random.default_rng(4)
    q = {"plane": 3, "sphere": 4, "cylinder": 5}[kind]
    sensor, pose = random_pose(rng), random_pose(rng)
    random, systematic, motion = covariance(rng, q), covariance(rng, q, 3e-4), covariance(rng, 6, 2e-4)
    form = {
        "plane": lambda: LocalPlane(pose, random, systematic),
        "sphere": lambda: LocalSphere(pose[:3, 3], 0.3, random, systematic),
        "cylinder": lambda: LocalCylinder(pose, 0.2, random, systematic),
    }[kind]()
    draws = []
    for error in rng.multivariate_normal(np.zeros(6), motion, 1200):
        by = np.eye(4)
        by[:3, :3], by[:3, 3] = Rotation.from_rotvec(error[3:]).as_matrix(), error[:3]
        draws.append(relate(form, moved(form, sensor @ by @ np.linalg.inv(sensor))).difference)
    made = Filter(form).carried(in_fixed_frame(sensor, motion)).fused
    np.testing.assert_allclose(made.systematic, systematic, rtol=1e-9, atol=1e-15)
    more, wanted = made.covariance - random, np.cov(np.array(draws).T)
    scale = np.sqrt(np.outer(wanted.diagonal(), wanted.diagonal())) + 1e-12
    assert np.abs((more - wanted) / scale).max() < 0.15


def test_a_plane_that_is_carried_by_uncertain_motions_is_as_uncertain_as_it_says():
    """A wall seen twelve times by a sensor that guesses how it moved, over and over."""
    rng = np.random.default_rng(6)
    noise, drift, zero = np.diag([1e-3, 1e-3, 2e-3]) ** 2, np.diag([1e-3, 1e-3, 1e-3]) ** 2, np.zeros((3, 3))
    motion = np.zeros((6, 6))  # about the plane's own origin its parameters are those of the motion
    motion[3:5, 3:5], motion[2, 2] = drift[:2, :2], drift[2, 2]
    nees = {"told": [], "not told": []}
    for run in range(120):
        filters = dict.fromkeys(nees if run < 30 else ["told"])
        lies, total = np.zeros(3), NO_DRIFT
        for _ in range(12):
            seen = lies + rng.normal(size=3) * np.sqrt(noise.diagonal())
            for name in filters:
                if filters[name] is None:
                    first, anchor = LocalPlane(np.eye(4), noise, zero), seen
                    filters[name] = Filter(first, total)
                else:
                    known = filters[name].carried(total if name == "told" else NO_DRIFT)
                    known.add(Related(seen - anchor, noise, zero))
            lies = lies + rng.normal(size=3) * np.sqrt(drift.diagonal())
            total = total + motion
        for name, known in filters.items():
            fused = known.carried(total if name == "told" else NO_DRIFT).fused
            first = LocalPlane(np.eye(4), noise, zero)
            error = relate(first, fused).difference + anchor - lies
            nees[name].append(error @ np.linalg.solve(fused.covariance, error) / 3)
    assert 0.8 < np.mean(nees["told"]) < 1.2
    assert np.mean(nees["not told"]) > 3


def test_many_planes_at_once_are_as_each_on_its_own():
    """A few frames of planes, some of which have moved, turned over, or are none."""
    rng = np.random.default_rng(11)
    sensor, limit, drift = rng.normal(size=3), matching.chi2_limit(1e-4, 3), np.zeros((6, 6))
    truth = [random_pose(rng) for _ in range(12)]
    made, alone, rows = FusedPlanes.none(12), [], np.arange(12)
    for frame in range(5):
        more_drift = covariance(rng, 6, 1e-4)
        drift = drift + more_drift
        forms: list = []
        for i, pose in enumerate(truth):
            off = rng.normal(size=6) * (0.3 if (i, frame) in {(3, 2), (5, 4)} else 1e-3)
            by = np.eye(4)
            by[:3, :3], by[:3, 3] = Rotation.from_rotvec(off[:3]).as_matrix(), off[3:]
            if (i, frame) == (4, 3):
                by = np.diag([1.0, -1.0, -1.0, 1.0])
            forms.append(LocalPlane(pose @ by, covariance(rng, 3), covariance(rng, 3, 3e-4)))
        seen = Planes.of([None, *forms])
        seen = seen._replace(row=seen.row[1:])
        if not alone:
            alone = [Filter(form, drift) for form in forms]
            assert not fuse(rows, made, seen, np.zeros((12, 3)), limit).any()
            continue
        more = seen.spread(sensor, 1e-6, 2e-6, 3e-6)
        made.carry(more_drift)
        fused = [one.carried(drift).fused for one in alone]
        for form, by_row in zip(forms, more, strict=True):
            np.testing.assert_allclose(
                by_row, matching.spread_by_pose(form, sensor, 1e-6, 2e-6, 3e-6), rtol=1e-9
            )
        allowed = np.ones((13, 12), bool)
        unknown = longer(made, FusedPlanes.none(1))
        forbid(allowed, np.arange(13), unknown, seen, more, limit)
        assert allowed[12].all()  # what has no shape
        for t, told in enumerate(fused):
            wanted = [matching.may_be_one(told, form, more[m], 1e-4) for m, form in enumerate(forms)]
            assert allowed[t].tolist() == wanted
        same = fuse(rows, made, seen, more, limit)
        assert same.tolist() == allowed.diagonal().tolist()
        for i, form in enumerate(forms):
            if same[i]:
                related = relate(alone[i].anchor, form)
                alone[i].add(
                    Related(related.difference, related.random + np.diag(more[i]), related.systematic)
                )
            else:
                spread = form.covariance + np.diag(more[i])
                alone[i] = Filter(LocalPlane(form.pose, spread, form.systematic), drift)
            one, other = made.fused()[i], alone[i].fused
            np.testing.assert_allclose(one.pose, other.pose, atol=1e-12)
            np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-7, atol=1e-15)
            np.testing.assert_allclose(one.systematic, other.systematic, rtol=1e-7, atol=1e-15)
        assert not same[3] if frame == 2 else not same[4] if frame == 3 else same.sum() > 8


def test_a_motion_is_found_where_three_planes_hold_it():
    from rcseg_core import segment
    from rcseg_core.synthetic import make_journey
    from rcseg_core.tracking.observation import observe

    first, second = islice(make_journey(60, 6, width=160, height=120), 2)
    results = [segment(f.scene.frame) for f in (first, second)]
    seen = [observe(result, result.world(), 2) for result in results]
    true = np.linalg.inv(second.scene.pose) @ first.scene.pose
    motion, held, covariance = estimate_motion(seen[0].points.xyz, seen[1], [np.eye(4)])
    assert held
    assert np.abs(motion[:3, 3] - true[:3, 3]).max() < 0.003
    assert np.abs(motion[:3, :3] - true[:3, :3]).max() < 0.003
    error = np.append(
        motion[:3, 3] - true[:3, 3], Rotation.from_matrix(motion[:3, :3] @ true[:3, :3].T).as_rotvec()
    )
    assert error @ np.linalg.solve(covariance, error) < chi2.isf(1e-4, 6)


def test_a_wall_alone_holds_no_motion():
    from rcseg_core import PinholeCamera, RangeColorFrame, segment
    from rcseg_core.tracking.observation import observe

    depth = np.full((48, 64), 1.5, np.float32) + np.random.default_rng(0).normal(0, 1e-3, (48, 64)).astype(
        np.float32
    )
    color = np.full((48, 64, 3), 120, np.uint8)
    result = segment(RangeColorFrame.from_depth(depth, color, PinholeCamera(60.0, 60.0, 31.5, 23.5)))
    seen = observe(result, result.world(), 2)
    motion, held, _ = estimate_motion(seen.points.xyz, seen, [np.eye(4)])
    assert not held
    np.testing.assert_allclose(motion, np.eye(4), atol=1e-3)
