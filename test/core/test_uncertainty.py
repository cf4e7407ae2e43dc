"""Whether stated errors hold: errors as they were made, classes, and a whole scene."""

from dataclasses import replace

import numpy as np
import pytest
from oracle import naive_plane_forms as naive
from scipy.spatial.transform import Rotation

from rcseg_core import segment
from rcseg_core.evaluation.uncertainty import (
    LEVELS,
    ErrorCheck,
    check_uncertainty,
    cylinder_error,
    plane_error,
    sphere_error,
    summarise,
    true_kind,
)
from rcseg_core.shapes.local_forms import LocalCylinder, LocalSphere
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.synthetic import make_scene


def pose_of(rng):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng.integers(2**31)).as_matrix()
    pose[:3, 3] = rng.uniform(-1, 3, 3)
    return pose


@pytest.mark.parametrize("seed", range(5))
def test_the_error_of_a_plane_is_what_was_done_to_it(seed):
    rng = np.random.default_rng(seed)
    pose, step = pose_of(rng), rng.normal(0, 1e-4, 3)
    normal, point = naive.disturbed(pose, *step)
    x = np.cross(normal, rng.normal(size=3))
    flat = rng.uniform(-1, 1, (50, 2)) @ np.stack([x, np.cross(normal, x)])
    normals = np.tile(normal, (50, 1))
    found = plane_error(LocalPlane(pose, np.eye(3), np.eye(3)), point + flat, normals)
    np.testing.assert_allclose(found, step, atol=1e-7)
    assert true_kind(normals) == "plane"


@pytest.mark.parametrize("seed", range(5))
def test_the_error_of_a_cylinder_is_what_was_done_to_it(seed):
    rng = np.random.default_rng(seed)
    pose, step = pose_of(rng), rng.normal(0, 1e-4, 5)
    turn = pose[:3, :3] @ Rotation.from_rotvec([step[0], step[1], 0]).as_matrix()
    angle, height = rng.uniform(0, 2, 200), rng.uniform(-0.3, 0.3, 200)
    normals = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1) @ turn.T
    origin = pose[:3, 3] + pose[:3, :2] @ step[2:4]
    points = origin + (0.2 + step[4]) * normals + height[:, None] * turn[:, 2]
    found = cylinder_error(LocalCylinder(pose, 0.2, np.eye(5), np.eye(5)), points, normals)
    np.testing.assert_allclose(found, step, atol=1e-7)
    assert true_kind(normals) == "cylinder"


def test_the_error_of_a_sphere_is_what_was_done_to_it():
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(100, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found = sphere_error(
        LocalSphere(np.array([1.0, 2, 3]), 0.3, np.eye(4), np.eye(4)),
        (1.001, 2, 3) + 0.302 * normals,
        normals,
    )
    np.testing.assert_allclose(found, (0.001, 0, 0, 0.002), atol=1e-9)
    assert true_kind(normals) == "sphere"


def check(**changes):
    held = (0.0, 1.0, 1.0, 1.0)
    return replace(ErrorCheck("plane", 1, "room", 0, 600, 1.5, 3, 2.0, held), **changes)


def test_rows_by_family_size_and_depth():
    checks = [
        check(), check(nees=0.5, held=(1.0,) * 4, pixels=300), check(family="blocks", depth_m=4.0, nees=0.2),
        check(what="sphere"),
    ]  # fmt: skip
    rows = {(row["what"], row["by"], row["class"]): row for row in summarise(checks)}
    assert rows["plane", "all", ""]["count"] == 3
    assert rows["plane", "all", ""]["nees"] == pytest.approx(0.9)
    assert rows["plane", "all", ""]["nees_median"] == 0.5
    assert rows["plane", "all", ""]["held_50"] == pytest.approx(1 / 3)
    assert rows["plane", "all", "500 px and more"]["count"] == 2
    assert rows["plane", "pixels", "below 500"]["nees"] == 0.5
    assert rows["plane", "pixels", "500-2000"]["count"] == 2
    assert rows["plane", "family", "room"]["count"] == 2
    assert rows["plane", "depth_m", "3 and more"]["nees"] == 0.2
    assert rows["sphere", "all", ""]["count"] == 1
    assert summarise([]) == []


def test_a_scene_tells_its_shapes_and_patches():
    scene = make_scene("curved", 1, width=320, height=240)
    result = segment(scene.frame)
    checks = check_uncertainty(scene, result)
    assert {c.what for c in checks} == {"plane", "sphere", "cylinder", "control points"}
    assert {c.dof for c in checks if c.what == "cylinder"} == {5}
    assert all(len(c.held) == len(LEVELS) and c.nees >= 0 and 0.2 < c.depth_m < 6 for c in checks)
    shapes = [c for c in checks if c.what != "control points"]
    assert np.median([c.nees for c in shapes]) < 4
    for c in shapes:
        assert list(c.held) == sorted(c.held)


def test_smaller_stated_errors_are_caught():
    scene = make_scene("room", 1, width=320, height=240)
    result = segment(scene.frame)

    def told(share):
        """Checks of the planes with a share of their random covariance, and nothing systematic."""
        none, surfaces = np.zeros((3, 3)), result.surfaces
        result.__dict__["surfaces"] = [
            replace(s, local=replace(s.local, covariance=share * s.local.covariance, systematic=none))
            if s.plane
            else s
            for s in surfaces
        ]
        checks = [c for c in check_uncertainty(scene, result) if c.what == "plane"]
        result.__dict__["surfaces"] = surfaces
        return checks

    honest, caught = told(1.0), told(0.01)
    assert [c.nees for c in honest] == [c.nees_random for c in honest]
    np.testing.assert_allclose([c.nees for c in caught], [100 * c.nees for c in honest])
    assert np.mean([c.held[2] for c in caught]) < 0.5 <= np.mean([c.held[2] for c in honest])


def test_control_points_are_compared_with_those_of_the_exact_signal():
    """On a plane inverse depth is linear, so that every degree has it exactly, whatever the pixels."""
    scene = make_scene("room", 2, width=320, height=240, noise=1e-3)
    result = segment(scene.frame)
    true, stated = [], []
    for c in (c for c in check_uncertainty(scene, result) if c.what == "control points"):
        patch = result.regions[c.label - 1].range_patch
        true.append(c.nees)
        stated.append(np.median(patch.standard_errors))
    assert np.median(true) < 10 and np.median(stated) < 1e-4


def test_correlated_pixels_count_for_fewer_in_control_points():
    """Through structured light some fifteen pixels make one measurement; as independent ones they claim 3.8
    times too much."""
    scene = make_scene("room", 1, structured_light=True)
    result = segment(scene.frame)
    checks = [c for c in check_uncertainty(scene, result) if c.what == "control points"]
    large = [c.nees for c in checks if c.pixels >= 500]
    assert len(large) > 20 and result.noise.range_correlation > 8
    assert np.median(large) < 3
