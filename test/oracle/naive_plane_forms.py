"""What gtsam and g2o make of a plane, from their definitions, and derivatives by differences.

Imports nothing of the product.
"""

import numpy as np
from scipy.spatial.transform import Rotation


def disturbed(pose, tilt_x, tilt_y, offset):
    """Unit normal (3,) and a point (3,) of a plane z = 0 of a pose after turns about its axes and a shift."""
    rotation = pose[:3, :3] @ Rotation.from_rotvec([tilt_x, tilt_y, 0.0]).as_matrix()
    return rotation[:, 2], pose[:3, 3] + offset * pose[:3, 2]


def coefficients(pose, step=(0.0, 0.0, 0.0)):
    """n, d with n . p + d = 0."""
    normal, point = disturbed(pose, *step)
    return np.append(normal, -normal @ point)


def closest_point(pose, step=(0.0, 0.0, 0.0)):
    normal, point = disturbed(pose, *step)
    return (normal @ point) * normal


def g2o_ominus(one, other):
    """The step v for which g2o's ``other.oplus(v)`` is `one`; coefficients (4,) each."""
    azimuth = np.arctan2(other[1], other[0])
    elevation = np.arctan2(other[2], np.sqrt(other[0] ** 2 + other[1] ** 2))
    turn = Rotation.from_rotvec([0, 0, azimuth]) * Rotation.from_rotvec([0, -elevation, 0])
    local = turn.inv().apply(one[:3])
    up = np.arctan2(local[2], np.hypot(local[0], local[1]))
    return np.array([np.arctan2(local[1], local[0]), up, other[3] - one[3]])


def moved_covariance(function, covariance, step=1e-6):
    """J C J^T with the derivatives of function((3,) local errors) at zero, by central differences."""
    columns = [
        (function(tuple(step * e)) - function(tuple(-step * e))) / (2 * step) for e in np.eye(len(covariance))
    ]
    table = np.stack(columns, axis=1)
    return table @ covariance @ table.T
