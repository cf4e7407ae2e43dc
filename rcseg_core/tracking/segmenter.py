"""Stability at the source: decisions near the limit keep what the last frame decided.

The pixels of a frame look up what the last one decided of the place that they show: the motion takes them
there, and what lies at another depth there is not known. `segment` groups with that, see `Held`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.compute.parallel import over_bands
from rcseg_core.config import SegmenterConfig
from rcseg_core.frame import RangeColorFrame
from rcseg_core.models.polynomials import Models, predict
from rcseg_core.partition.previous import Previous
from rcseg_core.pipeline import DEFAULT, segment
from rcseg_core.result.segmentation import Segmentation
from rcseg_core.tracking.motion import estimate_motion
from rcseg_core.tracking.observation import lens_of
from rcseg_core.tracking.tracker import REFERENCE_WIDTH_PX, check_pose, check_stamp, why_apart

Array = NDArray[np.float64]


class _Seen(NamedTuple):
    """What is kept of a frame: see `Observation`."""

    labels: NDArray[np.int32]
    surface_labels: NDArray[np.int32]
    lens: Array
    models: Models
    scale: Array
    offset: Array


class Segmenter:
    """Segments frame after frame, with ``tracking.stability`` in favour of what the last frame decided.

    Where that is 0, and for the first frame, the result is that of `segment`.

    Parameters
    ----------
    config : SegmenterConfig, the defaults if None
    """

    def __init__(self, config: SegmenterConfig | None = None) -> None:
        self.config = config or DEFAULT
        self._last: _Seen | None = None
        self._stamp_ns, self._pose, self._posed = 0, np.eye(4), False
        self._back = np.eye(4)

    def segment(
        self, frame: RangeColorFrame, stamp_ns: int, pose: NDArray[Any] | None = None
    ) -> Segmentation:
        """The result of the next frame.

        Parameters
        ----------
        frame : RangeColorFrame
        stamp_ns, pose : as `Tracker.update` takes them; where that begins anew, so does this

        Raises
        ------
        ConfigError, InputError
        """
        given = None if pose is None else check_pose(pose)
        stamp_ns = check_stamp(stamp_ns)
        if self.config.tracking.stability == 0.0:
            return segment(frame, self.config)
        previous = self._previous(frame, stamp_ns, given)
        result = segment(frame, self.config, previous=previous)
        signals = result.signals
        self._last = _Seen(
            result.labels, result.surface_labels, lens_of(result), result.models, signals.scale,
            signals.offset,
        )  # fmt: skip
        self._stamp_ns, self._pose = stamp_ns, np.eye(4) if given is None else given
        self._posed = given is not None
        return result

    def _previous(self, frame: RangeColorFrame, stamp_ns: int, given: Array | None) -> Previous | None:
        """What the last frame decided, on the pixels of this one."""
        last, config = self._last, self.config.tracking
        back, self._back = self._back, np.eye(4)
        if last is None:
            return None
        gap_s, posed = (stamp_ns - self._stamp_ns) / 1e9, given is not None
        if why_apart(gap_s, posed, self._posed, config.max_gap_s):
            return None
        if last.lens[0] == 0.0 and last.labels.shape != frame.valid.shape:
            return None
        step = max(1, round(config.cell_px * frame.width / REFERENCE_WIDTH_PX))
        some = frame.points[::step, ::step][frame.valid[::step, ::step]].astype(np.float64)
        if given is not None and self._posed:
            move = np.asarray(np.linalg.inv(self._pose) @ given, np.float64)
            sigma = np.sqrt(2.0) * config.pose_sigma_m, np.sqrt(2.0) * config.pose_sigma_rad
            if min(sigma) > 0.0:
                move = estimate_motion(some, last, [move], sigma)[0]
        else:
            move = estimate_motion(some, last, [np.eye(4), back])[0]
            self._back = move
        return _looked_up(frame, last, move, config.depth_tolerance)


@bare
def _look_up(points, valid, move, labels, surfaces, lens, models, scale, offset, tolerance, first, last, out):  # type: ignore[no-untyped-def]
    """Rows first..last-1 of out (2, H, W): surface and region that the last frame had where a pixel looks."""
    height, width = labels.shape
    for row in range(first, last):
        for col in range(valid.shape[1]):
            out[0, row, col] = 0
            out[1, row, col] = 0
            if not valid[row, col]:
                continue
            px, py, pz = points[row, col, 0], points[row, col, 1], points[row, col, 2]
            x = move[0, 0] * px + move[0, 1] * py + move[0, 2] * pz + move[0, 3]
            y = move[1, 0] * px + move[1, 1] * py + move[1, 2] * pz + move[1, 3]
            z = move[2, 0] * px + move[2, 1] * py + move[2, 2] * pz + move[2, 3]
            r, c = row, col
            if lens[0] > 0.0:
                if not z > 1e-6:
                    continue
                at_row, at_col = y / z * lens[1] + lens[3], x / z * lens[0] + lens[2]
                if not (-0.5 <= at_row < height - 0.5 and -0.5 <= at_col < width - 0.5):
                    continue
                r, c = int(at_row + 0.5), int(at_col + 0.5)
            k = labels[r, c]
            if k <= 0:
                continue
            if lens[0] > 0.0:
                miss = abs((predict(models, k, r, c, 0, 0) * scale[0] + offset[0]) * z - 1.0)
            else:  # the same place of the grid; far from the sensor things may differ by more
                dx = predict(models, k, r, c, 0, 0) * scale[0] + offset[0] - x
                dy = predict(models, k, r, c, 0, 1) * scale[1] + offset[1] - y
                dz = predict(models, k, r, c, 0, 2) * scale[2] + offset[2] - z
                miss = np.sqrt((dx * dx + dy * dy + dz * dz) / max(x * x + y * y + z * z, 1e-12))
            if miss <= tolerance:
                out[0, row, col] = surfaces[r, c]
                out[1, row, col] = k


def _looked_up(frame: RangeColorFrame, last: _Seen, move: Array, tolerance: float) -> Previous:
    out = np.empty((2, *frame.valid.shape), np.int32)

    def look_up(_: int, first: int, end: int) -> None:
        _look_up(
            frame.points, frame.valid, move, last.labels, last.surface_labels, last.lens, last.models,
            last.scale, last.offset, tolerance, first, end, out,
        )  # fmt: skip

    over_bands(frame.height, look_up)
    return Previous(out[0], out[1])
