"""Planes in the forms of other programs: by finite differences of their definitions, and by gtsam itself."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import naive_plane_forms as naive
from scipy.spatial.transform import Rotation

from rcseg_core.errors import InputError
from rcseg_core.shapes.plane_forms import LocalPlane, g2o_rotation, gtsam_basis

seeds = st.integers(0, 2**32 - 1)
SPECIAL = [(0, 0, -1), (0, 0, 1), (0, -1, 0), (-1, 0, 0), (1, 1, 1), (1, -1, 0), (0, 1, -1)]


def plane_of(seed, normal=None):
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng.integers(2**31)).as_matrix()
    if normal is not None:
        z = np.array(normal) / np.linalg.norm(normal)
        x = np.cross(z, rng.normal(size=3))
        x /= np.linalg.norm(x)
        pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    pose[:3, 3] = rng.uniform(-2, 4, 3)
    roots = rng.normal(size=(2, 3, 3)) * (0.01, 0.02, 0.005)
    return LocalPlane(pose, roots[0].T @ roots[0], roots[1].T @ roots[1])


def close(found, wanted):
    scale = np.abs(wanted).max()
    np.testing.assert_allclose(found, wanted, atol=1e-7 * scale, rtol=1e-6)


def check_all(plane):
    pose, total = plane.pose, plane.covariance + plane.systematic
    at = naive.coefficients(pose)
    for form in (plane.to_gtsam, plane.to_g2o, plane.to_hessian):
        np.testing.assert_allclose(form()[0], at, atol=1e-12)
    close(plane.to_hessian()[1], naive.moved_covariance(lambda s: naive.coefficients(pose, s), total))
    np.testing.assert_allclose(plane.to_closest_point()[0], naive.closest_point(pose), atol=1e-12)
    close(plane.to_closest_point()[1], naive.moved_covariance(lambda s: naive.closest_point(pose, s), total))
    steps = naive.moved_covariance(lambda s: naive.g2o_ominus(naive.coefficients(pose, s), at), total)
    close(plane.to_g2o()[1], steps)


@given(seeds)
@settings(max_examples=100, deadline=None)
def test_conversions_are_the_derivatives_of_their_definitions(seed):
    check_all(plane_of(seed))


@pytest.mark.parametrize("normal", SPECIAL)
def test_normals_along_axes_and_diagonals(normal):
    check_all(plane_of(3, normal))
    basis = gtsam_basis(np.array(normal) / np.linalg.norm(normal))
    np.testing.assert_allclose(basis.T @ basis, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(basis.T @ np.array(normal), 0, atol=1e-12)
    turn = g2o_rotation(np.array(normal) / np.linalg.norm(normal))
    np.testing.assert_allclose(turn[:, 0], np.array(normal) / np.linalg.norm(normal), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)


def test_the_residual_of_a_g2o_edge_counts_the_distance_the_other_way():
    """Plane3D::ominus of what is predicted and what was measured, as its source says."""
    plane = plane_of(9)
    predicted = naive.coefficients(plane.pose)

    def residual(step):
        measured = naive.coefficients(plane.pose, step)
        forward = naive.g2o_ominus(measured, predicted)
        return np.array([forward[0], forward[1], -predicted[3] + measured[3]])

    total = plane.covariance + plane.systematic
    close(plane.to_g2o_edge()[1], naive.moved_covariance(residual, total))
    np.testing.assert_array_equal(plane.to_g2o_edge()[0], plane.to_g2o()[0])


def test_parts_add_up():
    plane = plane_of(5)
    for form in (plane.to_gtsam, plane.to_g2o, plane.to_hessian, plane.to_closest_point):
        np.testing.assert_allclose(form("random")[1] + form("systematic")[1], form()[1], atol=1e-12)
        np.testing.assert_array_equal(form()[1], form("total")[1])
    with pytest.raises(InputError, match="'half'"):
        plane.to_gtsam("half")


def test_every_point_of_the_plane_fulfils_the_equation():
    plane = plane_of(6)
    points = plane.origin + np.random.default_rng(0).normal(size=(5, 2)) @ plane.pose[:3, :2].T
    parameters, covariance = plane.to_hessian()
    np.testing.assert_allclose(points @ parameters[:3] + parameters[3], 0, atol=1e-12)
    assert np.linalg.matrix_rank(covariance, tol=1e-12) == 3
    # the error of the plane's height at its own centroid is the offset alone
    row = np.append(plane.origin, 1.0)
    assert row @ covariance @ row == pytest.approx((plane.covariance + plane.systematic)[2, 2])


@given(seeds, st.sampled_from([None, *SPECIAL]))
@settings(max_examples=60, deadline=None)
def test_gtsam_agrees(seed, normal):
    gtsam = pytest.importorskip("gtsam")
    plane = plane_of(seed, normal)
    parameters, covariance = plane.to_gtsam()
    theirs = gtsam.OrientedPlane3(parameters)
    np.testing.assert_allclose(theirs.planeCoefficients(), parameters, atol=1e-12)
    np.testing.assert_allclose(gtsam.Unit3(plane.normal).basis(), gtsam_basis(plane.normal), atol=1e-12)

    def local(step):
        return theirs.localCoordinates(gtsam.OrientedPlane3(naive.coefficients(plane.pose, step)))

    close(covariance, naive.moved_covariance(local, plane.covariance + plane.systematic, 1e-5))
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    assert noise.covariance() == pytest.approx(covariance, abs=1e-9)


def test_a_plane_goes_into_a_gtsam_graph_and_comes_out_as_it_went_in():
    gtsam = pytest.importorskip("gtsam")
    plane = plane_of(11)
    parameters, covariance = plane.to_gtsam_factor()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(1, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-7)))
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    graph.add(gtsam.OrientedPlane3Factor(parameters, noise, 1, 2))
    values.insert(1, gtsam.Pose3())
    values.insert(2, gtsam.OrientedPlane3(parameters).retract(np.array([0.02, -0.01, 0.03])))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    np.testing.assert_allclose(found.atOrientedPlane3(2).planeCoefficients(), parameters, atol=1e-6)
    marginal, wanted = gtsam.Marginals(graph, found).marginalCovariance(2), plane.to_gtsam()[1]
    np.testing.assert_allclose(marginal, wanted, atol=1e-4 * np.abs(wanted).max())
