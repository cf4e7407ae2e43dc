"""A plane with three errors that exist, and the forms in which other programs take it.

A plane has three degrees of freedom: two tilts of its normal and an offset along it. About its own centroid,
with axes along its spread, these three are nearly independent, and none of them depends on how far away the
sensor's origin is. Every other form follows by derivatives that are exact at the plane itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rcseg_core.errors import InputError

Array = NDArray[np.float64]

PARTS = ("total", "random", "systematic")
OPPOSITE = np.array([[1.0, 1.0, -1.0], [1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
"""Signs of covariances whose third error counts the other way."""


@dataclass(frozen=True)
class LocalPlane:
    """A plane in its minimal local form, in the camera's (scanner's) frame.

    Attributes
    ----------
    pose : (4, 4) float64
        Of the plane's axes in the sensor's frame, m. Origin: centroid of the surface, on the plane. x: along
        the longest spread of the surface. z: the normal, towards the sensor. y completes a right-handed
        frame.
    covariance : (3, 3) float64
        Random part of the errors of tilt about x, tilt about y (rad), offset along z (m). Independent from
        frame to frame.
    systematic : (3, 3) float64
        What no number of pixels averages away, in the same order; the same in frame after frame while the
        sensor stands still. Zero where nothing is known of it.
    """

    pose: Array
    covariance: Array
    systematic: Array

    @property
    def normal(self) -> Array:
        """(3,) unit normal, towards the sensor."""
        return np.asarray(self.pose[:3, 2])

    @property
    def origin(self) -> Array:
        """(3,) centroid, m."""
        return np.asarray(self.pose[:3, 3])

    @property
    def distance(self) -> float:
        """normal . p of all points p of the plane, m; the sensor's distance from it is minus that."""
        return float(self.normal @ self.origin)

    def covariance_of(self, part: str = "total") -> Array:
        """(3, 3) `covariance` ("random"), `systematic`, or their sum ("total").

        Raises
        ------
        InputError
            For another part.
        """
        if part not in PARTS:
            raise InputError(f"part: expected one of {', '.join(PARTS)}, got {part!r}")
        parts = {"random": self.covariance, "systematic": self.systematic}
        return np.asarray(parts[part] if part in parts else self.covariance + self.systematic)

    def to_gtsam(self, part: str = "total") -> tuple[Array, Array]:
        """gtsam's ``OrientedPlane3``: normal . p + d = 0.

        Parameters
        ----------
        part : "total", "random" or "systematic", the errors that are converted

        Returns
        -------
        parameters : (4,) float64, ``planeCoefficients()``: unit normal and d, m
        covariance : (3, 3) float64 of gtsam's local coordinates: the normal along the two columns of
            ``Unit3.basis()``, rad, and d, m; of ``retract``, ``localCoordinates`` and ``Marginals``. A factor
            takes `to_gtsam_factor`
        """
        basis = gtsam_basis(self.normal)
        table = np.vstack([basis.T @ self._turns(), -self._distance_change()])
        return self._coefficients(), self._moved(table, part)

    def to_gtsam_factor(self, part: str = "total") -> tuple[Array, Array]:
        """Measurement and covariance of the noise model of gtsam's ``OrientedPlane3Factor``.

        As `to_gtsam`, but its residual is measured less predicted in the normal, and predicted less measured
        in d: the covariances between the two have the other sign.
        """
        parameters, covariance = self.to_gtsam(part)
        return parameters, covariance * OPPOSITE

    def to_g2o(self, part: str = "total") -> tuple[Array, Array]:
        """g2o's ``Plane3D``; `part` as in `to_gtsam`.

        Returns
        -------
        parameters : (4,) float64, ``coeffs()``: unit normal and d, m, with normal . p + d = 0
        covariance : (3, 3) float64 of the step that ``oplus`` takes: azimuth and elevation in the plane's own
            frame, rad, and ``distance()``, which is -d, m
        """
        table = np.vstack([g2o_rotation(self.normal)[:, 1:].T @ self._turns(), self._distance_change()])
        return self._coefficients(), self._moved(table, part)

    def to_g2o_edge(self, part: str = "total") -> tuple[Array, Array]:
        """Measurement and covariance (inverse information) of g2o's ``EdgeSE3PlaneSensorCalib``.

        As `to_g2o`, but its residual, ``ominus``, is measured less predicted in azimuth and elevation, and
        predicted less measured in the distance.
        """
        parameters, covariance = self.to_g2o(part)
        return parameters, covariance * OPPOSITE

    def to_hessian(self, part: str = "total") -> tuple[Array, Array]:
        """Hesse's normal form normal . p + d = 0; `part` as in `to_gtsam`.

        Returns
        -------
        parameters : (4,) float64: unit normal and d, m; d is the sensor's distance from the plane
        covariance : (4, 4) float64 of these, of rank 3: a unit normal does not vary along itself
        """
        table = np.vstack([self._turns(), -self._distance_change()])
        return self._coefficients(), self._moved(table, part)

    def to_closest_point(self, part: str = "total") -> tuple[Array, Array]:
        """The point of the plane that is closest to the sensor; `part` as in `to_gtsam`.

        Returns
        -------
        parameters : (3,) float64, m; (0, 0, 0) for a plane through the sensor, which it cannot tell
        covariance : (3, 3) float64, m^2
        """
        table = self.distance * self._turns() + np.outer(self.normal, self._distance_change())
        return self.distance * self.normal, self._moved(table, part)

    def _coefficients(self) -> Array:
        return np.append(self.normal, -self.distance)

    def _turns(self) -> Array:
        """(3, 3) change of the normal by each local error: turns about x move it by -y, about y by x."""
        return np.stack([-self.pose[:3, 1], self.pose[:3, 0], np.zeros(3)], axis=1)

    def _distance_change(self) -> Array:
        """(3,) change of `distance` with each local error: the plane turns about its own origin."""
        return np.asarray(self._turns().T @ self.origin + np.array([0.0, 0.0, 1.0]))

    def _moved(self, table: Array, part: str) -> Array:
        return np.asarray(table @ self.covariance_of(part) @ table.T)


def gtsam_basis(normal: Array) -> Array:
    """(3, 2) the tangent basis that gtsam's ``Unit3::basis`` chooses for a unit vector (3,)."""
    least = int(np.argmin(np.abs(normal)))  # of equal ones the first, as there
    first = np.cross(normal, np.eye(3)[least])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)], axis=1)


def g2o_rotation(normal: Array) -> Array:
    """(3, 3) the rotation that g2o's ``Plane3D::rotation`` takes x to a unit vector (3,) with: by elevation
    about -y, then by azimuth about z."""
    azimuth = np.arctan2(normal[1], normal[0])
    elevation = np.arctan2(normal[2], np.hypot(normal[0], normal[1]))
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    return np.array([[ce * ca, -sa, -se * ca], [ce * sa, ca, -se * sa], [se, 0.0, ce]])
