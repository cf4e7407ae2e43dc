"""What is looked at: the surfaces of a result with their models, and the points that were measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.config import WorldConfig
from rcseg_core.frame import PinholeCamera
from rcseg_core.models.polynomials import Models
from rcseg_core.shapes.local_forms import LocalCylinder, LocalSphere
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.shapes.primitives import Primitive
from rcseg_core.signal.signals import INVALID, Signals

#: Points that tell what lies behind a plane.
SAMPLE = 8000


class Shaped(Protocol):
    """A surface with its shape: what the world reads of a `segmentation.Surface`."""

    @property
    def label(self) -> int: ...
    @property
    def pixel_count(self) -> int: ...
    @property
    def box(self) -> tuple[int, int, int, int]: ...
    @property
    def regions(self) -> tuple[int, ...]: ...
    @property
    def primitive(self) -> Primitive: ...
    @property
    def candidates(self) -> tuple[Primitive, ...]: ...
    @property
    def local(self) -> LocalPlane | LocalSphere | LocalCylinder | None: ...


@dataclass(frozen=True)
class Scene:
    """A segmentation as the world sees it.

    Attributes
    ----------
    labels, surface_labels : (H, W) int32, regions and surfaces, 0 unlabelled
    camera : PinholeCamera or None, that of the frame
    measure : the whitened signals and the models of the regions
    describe : the surfaces 1..M
    config : WorldConfig
    known : what was found out about it, by name; each room keeps its own there
    """

    labels: NDArray[np.int32]
    surface_labels: NDArray[np.int32]
    camera: PinholeCamera | None
    measure: Callable[[], tuple[Signals, Models]]
    describe: Callable[[], Sequence[Shaped]]
    config: WorldConfig
    known: dict[object, Any] = field(default_factory=dict, repr=False)

    @cached_property
    def surfaces(self) -> Sequence[Shaped]:
        """Surfaces 1..M, ``surfaces[i].label == i + 1``."""
        return self.describe()

    @cached_property
    def planes(self) -> tuple[LocalPlane | None, ...]:
        """(M,) the plane of each surface that is one."""
        return tuple(s.local if isinstance(s.local, LocalPlane) else None for s in self.surfaces)

    @property
    def signals(self) -> Signals:
        return self.measure()[0]

    @property
    def models(self) -> Models:
        return self.measure()[1]

    @cached_property
    def measured(self) -> NDArray[np.bool_]:
        """(H, W) bool: pixels that have depth."""
        return np.asarray(self.signals.flags & INVALID == 0)

    @cached_property
    def points(self) -> NDArray[np.float32]:
        """(H, W, 3) float32, m: the measured points; NaN where there is no depth."""
        points = np.empty((*self.labels.shape, 3), np.float32)
        lens = self._lens
        across = (np.arange(points.shape[1]) - lens[2]) / (lens[0] or 1.0)
        signals = self.signals
        _measure(signals.image, signals.flags, signals.scale, signals.offset, lens, across, points)
        return points

    def points_at(self, rows: NDArray[np.int64], cols: NDArray[np.int64]) -> NDArray[np.float32]:
        """(n, 3) `points` of some pixels (n,), without those of all others."""
        points, signals = np.empty((len(rows), 3), np.float32), self.signals
        _measure_at(
            signals.image, signals.flags, signals.scale, signals.offset, self._lens, rows, cols, points
        )
        return points

    @property
    def _lens(self) -> NDArray[np.float64]:
        """(4,) fx, fy, cx, cy; 0 where channels are x, y, z."""
        if not self.signals.inverse_depth:
            return np.zeros(4)
        camera = self.camera
        assert camera is not None
        return np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64)

    @cached_property
    def sample(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(n, 3) some `SAMPLE` of the points, all over the image, and (n,) how far each is from the origin,
        m."""
        stride = 1 + int(np.sqrt(self.labels.size / SAMPLE))
        height, width = self.labels.shape
        rows, cols = np.mgrid[:height:stride, :width:stride].reshape(2, -1)
        points = self.points_at(rows, cols).astype(np.float64)
        points = points[np.isfinite(points[:, 2])]
        return points, np.sqrt(np.einsum("ni,ni->n", points, points))


@bare
def _put_point(image, flags, scale, offset, inverse, row, col, across, down, point):  # type: ignore[no-untyped-def]
    """The measured point (3,) of a pixel."""
    if flags[row, col] & INVALID:
        point[:] = np.nan
    elif not inverse:
        for c in range(3):
            point[c] = image[row, col, c] * scale[c] + offset[c]
    else:
        depth = 1.0 / (image[row, col, 0] * scale[0] + offset[0])
        point[0] = across * depth
        point[1] = down * depth
        point[2] = depth


@bare
def _measure(image, flags, scale, offset, lens, across, points):  # type: ignore[no-untyped-def]
    """points (H, W, 3): the range of whitened signals; lens : (fx, fy, cx, cy), fx = 0 for x, y, z;
    across : (W,) x over depth."""
    inverse = lens[0] != 0.0
    for row in range(points.shape[0]):
        down = (row - lens[3]) / lens[1] if inverse else 0.0
        for col in range(points.shape[1]):
            _put_point(image, flags, scale, offset, inverse, row, col, across[col], down, points[row, col])


@bare
def _measure_at(image, flags, scale, offset, lens, rows, cols, points):  # type: ignore[no-untyped-def]
    """points (n, 3): `_measure` at pixels (n,)."""
    inverse = lens[0] != 0.0
    for i in range(rows.size):
        across = (cols[i] - lens[2]) / lens[0] if inverse else 0.0
        down = (rows[i] - lens[3]) / lens[1] if inverse else 0.0
        _put_point(image, flags, scale, offset, inverse, rows[i], cols[i], across, down, points[i])
