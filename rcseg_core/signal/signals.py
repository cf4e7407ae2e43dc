"""The two signals of section 2, whitened: one (H, W, C) image in which every residual counts in sigmas.

Range first (inverse depth, or x, y, z), colour after. Division by the noise once, here, is Sigma^-1 of eq.
(3): all later sums of squares are chi-squared. The range noise may depend on the signal, and the tolerance is
a share of depth, so both stay a small law of the (whitened) signal, evaluated once a region.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.compute.parallel import over_bands, together
from rcseg_core.config import SegmenterConfig
from rcseg_core.errors import ConfigError
from rcseg_core.frame import RangeColorFrame
from rcseg_core.signal.cleaning import color_median, local_median
from rcseg_core.signal.noise import NoiseModel, estimate_noise, typical_values
from rcseg_core.signal.units import UNIT_PX

# Flags of a pixel, a bit mask in `Signals.flags`.
INVALID, RANGE_OUTLIER, COLOR_OUTLIER = 1, 2, 4
#: Has the label of a neighbour although no model predicts it: counts for no fit.
MISFIT = 8
#: Neighbours of eight, like the pixel itself, that make it part of a line instead of an impulse.
COMPANY = 3
#: Least sigma of the range, in that at the median signal: as small as constant depth noise at a hundred times
#: the median depth. Every law of a sensor is positive at any depth; models may predict what lies behind it.
LEAST_SIGMA = 1e-4
#: Half of the window of the local median.
RIM_PX = 2


@dataclass(frozen=True)
class Signals:
    """Whitened signals of one frame and what is needed to turn them back.

    Attributes
    ----------
    image : (H, W, C) float32, C = Cr + 3; channel c is (signal - offset[c]) / scale[c]; 0 where invalid
    cleaned : (H, W, Cr) float32, the range of `image` with invalid pixels and impulses replaced by the local
        median
    cleaned_color : (H, W, 3) uint8, the colour with impulses replaced by the local median
    flags : (H, W) uint8 bit mask: 1 invalid, 2 range impulse, 4 colour impulse, 8 misfit (set later)
    n_range : Cr, 1 for inverse depth, 3 for x, y, z
    scale, offset : (C,) float64
    law : (5,) float64, `local_scales` reads it: variance of the whitened range noise and squared tolerances
    color_eps2 : squared colour tolerance (a distance in RGB) in sigma^2
    slope : (a, b); a + b s is the gradient per UNIT_PX of a surface tilted by 45 degrees, at signal value s
    noise : NoiseModel
    inverse_depth : bool
    """

    image: NDArray[np.float32]
    cleaned: NDArray[np.float32]
    cleaned_color: NDArray[np.uint8]
    flags: NDArray[np.uint8]
    n_range: int
    scale: NDArray[np.float64]
    offset: NDArray[np.float64]
    law: NDArray[np.float64]
    color_eps2: float
    slope: tuple[float, float]
    noise: NoiseModel
    inverse_depth: bool

    def range_only(self) -> Signals:
        """The same frame without colour."""
        n = self.n_range
        return replace(
            self,
            image=_channels(self.image, 0, n),
            flags=self.flags & np.uint8(INVALID | RANGE_OUTLIER | MISFIT),
            scale=self.scale[:n],
            offset=self.offset[:n],
        )

    def color_only(self) -> Signals:
        """The same frame without range; pixels without range stay invalid, misfits of the range do not."""
        n = self.n_range
        return replace(
            self,
            image=_channels(self.image, n, n + 3),
            flags=self.flags & np.uint8(INVALID | COLOR_OUTLIER),
            n_range=0,
            scale=self.scale[n:],
            offset=self.offset[n:],
        )


@bare
def _copy_channels(image, first_channel, first, last, out):  # type: ignore[no-untyped-def]
    for row in range(first, last):
        for col in range(out.shape[1]):
            for c in range(out.shape[2]):
                out[row, col, c] = image[row, col, first_channel + c]


def _channels(image: NDArray[np.float32], first: int, last: int) -> NDArray[np.float32]:
    """Channels first..last-1, contiguous."""
    out = np.empty((*image.shape[:2], last - first), np.float32)
    over_bands(out.shape[0], lambda _, a, b: _copy_channels(image, first, a, b, out))
    return out


@bare
def local_scales(law, value):  # type: ignore[no-untyped-def]
    """Variance of the range noise and squared range tolerance, in sigma^2, at a whitened signal value."""
    sigma = law[0] + value * (law[1] + value * law[2])
    if sigma < LEAST_SIGMA:
        sigma = LEAST_SIGMA
    eps = law[3] + law[4] * value
    return sigma * sigma, eps * eps


def scales(
    law: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """`local_scales` of an array."""
    variance, tolerance2 = np.empty_like(values), np.empty_like(values)
    _scales(law, values, variance, tolerance2)
    return variance, tolerance2


@bare
def _scales(law, values, variance, tolerance2):  # type: ignore[no-untyped-def]
    for k in range(values.size):
        variance[k], tolerance2[k] = local_scales(law, values[k])


def uses_inverse_depth(frame: RangeColorFrame, config: SegmenterConfig) -> bool:
    """Which range signal is modelled; a camera is needed for inverse depth."""
    if config.signal.kind == "inverse_depth" and frame.camera is None:
        raise ConfigError(
            "signal.kind = inverse_depth needs a camera model or a grid whose rays pass through the origin; "
            "this frame has neither"
        )
    return frame.camera is not None and config.signal.kind != "xyz"


def build_signals(frame: RangeColorFrame, color: NDArray[np.uint8], config: SegmenterConfig) -> Signals:
    """Measure the noise, flag impulses and whiten.

    Parameters
    ----------
    color : (H, W, 3) uint8, after the reflectance stage
    """
    valid = frame.valid
    inverse = uses_inverse_depth(frame, config)
    raw = range_signal(frame, inverse)
    median_r, median_c = np.empty_like(raw), np.empty(color.shape, np.uint8)
    together(lambda: local_median(raw, valid, median_r), lambda: color_median(color, median_c))
    typical = typical_values(raw, valid)
    noise = estimate_noise(raw, median_r, valid, color, median_c, inverse, config.noise, typical)

    n_range = raw.shape[2]
    scale = np.concatenate([_typical_sigma(noise, typical), noise.color])
    offset = np.concatenate([typical, np.full(3, 127.0)])
    law = _law(noise, scale[0], typical, inverse, frame, config.grouping.range_tolerance)
    eps_c = config.grouping.color_tolerance / noise.color

    image = np.empty((*valid.shape, n_range + 3), np.float32)
    cleaned, cleaned_color = np.empty_like(raw), np.empty(color.shape, np.uint8)
    flags = np.empty(valid.shape, np.uint8)

    levels = ((np.arange(256.0) - offset[n_range:, None]) / scale[n_range:, None]).astype(np.float32)

    def whiten_rows(_: int, first: int, last: int) -> None:
        whiten(
            raw, median_r, color, median_c, valid, scale, offset, levels, law, config.edges.outlier_threshold,
            first, last, image, cleaned, cleaned_color, flags,
        )  # fmt: skip

    over_bands(valid.shape[0], whiten_rows)
    return Signals(
        image, cleaned, cleaned_color, flags, n_range, scale, offset, law, float(np.sum(eps_c**2)) / 3.0,
        _slope(frame, scale, offset, inverse), noise, inverse,
    )  # fmt: skip


def _slope(
    frame: RangeColorFrame, scale: NDArray[np.float64], offset: NDArray[np.float64], inverse: bool
) -> tuple[float, float]:
    """Gradient of the last range channel on a surface tilted by 45 degrees, see `Signals.slope`."""
    if inverse:
        assert frame.camera is not None
        # dz = dx is dw = w^2 dx, and a pixel is dx = 1 / (f w): dw = w / f a pixel
        focal = float(np.sqrt(frame.camera.fx * frame.camera.fy))
        return UNIT_PX / focal * float(offset[0] / scale[0]), UNIT_PX / focal
    points = np.where(frame.valid[..., None], frame.points, np.nan)
    steps = np.hypot(*(np.diff(points[..., c], axis=1) for c in (0, 1)))
    pitch = float(np.nanmedian(steps)) if np.isfinite(steps).any() else 0.0
    return max(pitch, 1e-9) * UNIT_PX / float(scale[2]), 0.0


@bare
def _on_rim_slope(raw, median, row, col, scale, limit):  # type: ignore[no-untyped-def]
    """Whether a pixel at the rim of the image is near its surface continued from inside.

    The window of the median is one-sided there, so that on a slope the median lies off the surface.
    """
    height, width, n_range = raw.shape
    r = min(max(row, RIM_PX), height - 1 - RIM_PX)
    c = min(max(col, RIM_PX), width - 1 - RIM_PX)
    if (r == row and c == col) or min(height, width) < 5 * RIM_PX:
        return False
    step_r = (row < RIM_PX) - (row >= height - RIM_PX)  # one pixel inwards
    step_c = (col < RIM_PX) - (col >= width - RIM_PX)
    far = 0.0
    for k in range(n_range):
        center = np.float64(median[r, c, k])
        slope_r = 0.5 * (median[r + 2 * step_r, c, k] - center)
        slope_c = 0.5 * (median[r, c + 2 * step_c, k] - center)
        expected = center - slope_r * abs(row - r) - slope_c * abs(col - c)
        d = (raw[row, col, k] - expected) / scale[k]
        far = max(far, d * d)
    return far <= limit


@bare
def _in_company(image, row, col, scale, first, limit):  # type: ignore[no-untyped-def]
    """Whether enough neighbours share the colour or range of a pixel: a line of two pixels is no impulse.

    image : (H, W, k), whose channels have the sigmas scale[first], scale[first + 1] ...
    """
    height, width, channels = image.shape
    alike = 0
    for r in range(max(row - 1, 0), min(row + 2, height)):
        for c in range(max(col - 1, 0), min(col + 2, width)):
            far = 0.0
            for k in range(channels):
                d = (np.float64(image[r, c, k]) - np.float64(image[row, col, k])) / scale[first + k]
                far = max(far, d * d)
            alike += far <= limit
    return alike > COMPANY


@bare
def whiten(  # type: ignore[no-untyped-def]
    raw, median_r, color, median_c, valid, scale, offset, levels, law, threshold, first, last, image,
    cleaned, cleaned_color, flags,
):  # fmt: skip
    """Whiten rows first..last-1 of a frame into `image`, flag impulses, put the local median in their place.

    raw, median_r : (H, W, Cr) float32; color, median_c : (H, W, 3) uint8; valid : (H, W) bool;
    scale, offset : (C,) float64; levels : (3, 256) float32, the whitened value of each level of a colour;
    threshold : sigmas from the local median that make an impulse, 0 for none.
    Out: image (H, W, C), cleaned (H, W, Cr) float32; cleaned_color (H, W, 3), flags (H, W) uint8.
    """
    width, n_range = raw.shape[1], raw.shape[2]
    limit = threshold * threshold
    for row in range(first, last):
        for col in range(width):
            flag = 0
            far = 0.0
            for c in range(n_range):
                center = (median_r[row, col, c] - offset[c]) / scale[c]
                cleaned[row, col, c] = center
                value = (raw[row, col, c] - offset[c]) / scale[c]
                image[row, col, c] = value
                far = max(far, (value - center) * (value - center))
            if not valid[row, col]:
                flag = INVALID
                for c in range(n_range):
                    image[row, col, c] = 0.0
            else:
                var, _ = local_scales(law, np.float64(cleaned[row, col, 0]))
                if (
                    threshold > 0.0
                    and far > limit * var
                    and not _on_rim_slope(raw, median_r, row, col, scale, limit * var)
                    and not _in_company(raw, row, col, scale, 0, 0.25 * limit * var)
                ):
                    flag = RANGE_OUTLIER
                else:
                    for c in range(n_range):
                        cleaned[row, col, c] = image[row, col, c]
            away = False
            for c in range(3):
                level = color[row, col, c]
                image[row, col, n_range + c] = levels[c, level]
                cleaned_color[row, col, c] = level
                away |= abs(np.float64(level) - median_c[row, col, c]) > threshold * scale[n_range + c]
            if threshold > 0.0 and away and not _in_company(color, row, col, scale, n_range, limit):
                flag |= COLOR_OUTLIER
                for c in range(3):
                    cleaned_color[row, col, c] = median_c[row, col, c]
            flags[row, col] = flag


def range_signal(frame: RangeColorFrame, inverse: bool) -> NDArray[np.float32]:
    if not inverse:
        return np.where(frame.valid[..., None], frame.points, 0).astype(np.float32)
    out = np.empty((*frame.valid.shape, 1), np.float32)
    over_bands(frame.height, lambda _, a, b: _invert(frame.depth_m, frame.valid, a, b, out))
    return out


def measured_again(
    signals: Signals, frame: RangeColorFrame, color: NDArray[np.uint8], range_factor: float,
    color_factor: float,
) -> Signals:  # fmt: skip
    """Another image of the same scene, whitened like `signals` with noise that is larger by a factor each.

    No impulses are looked for, and `cleaned` is the image itself.
    """
    n = signals.n_range
    scale = signals.scale * np.repeat([range_factor, color_factor], [n, 3])
    law = signals.law.copy()
    law[:3] *= range_factor ** np.arange(3)  # of a value in other units; sigma itself grows as they do
    law[3] /= range_factor
    raw = range_signal(frame, signals.inverse_depth)
    image, flags = np.empty((*frame.valid.shape, n + 3), np.float32), np.empty(frame.valid.shape, np.uint8)
    levels = ((np.arange(256.0) - signals.offset[n:, None]) / scale[n:, None]).astype(np.float32)
    gain, offset = (1.0 / scale).astype(np.float32), signals.offset.astype(np.float32)
    over_bands(
        frame.height,
        lambda _, first, last: _whiten_only(
            raw, color, frame.valid, gain, offset, levels, first, last, image, flags
        ),
    )
    return replace(
        signals, image=image, cleaned=image[..., :n], cleaned_color=color, flags=flags, scale=scale, law=law,
        color_eps2=signals.color_eps2 / color_factor**2,
        slope=(signals.slope[0] / range_factor, signals.slope[1]),
    )  # fmt: skip


@bare
def _whiten_only(raw, color, valid, gain, offset, levels, first, last, image, flags):  # type: ignore[no-untyped-def]
    """Rows of image (H, W, C) float32, and flags: only what is invalid."""
    n_range = raw.shape[2]
    for row in range(first, last):
        for col in range(raw.shape[1]):
            flags[row, col] = 0 if valid[row, col] else INVALID
            for c in range(n_range):
                value = (raw[row, col, c] - offset[c]) * gain[c]
                image[row, col, c] = value if valid[row, col] else np.float32(0.0)
            for c in range(3):
                image[row, col, n_range + c] = levels[c, color[row, col, c]]


@bare
def _invert(depth_m, valid, first, last, out):  # type: ignore[no-untyped-def]
    """out = 1 / depth, 0 where invalid."""
    for row in range(first, last):
        for col in range(out.shape[1]):
            out[row, col, 0] = 1.0 / depth_m[row, col] if valid[row, col] else 0.0


def _typical_sigma(noise: NoiseModel, typical: NDArray[np.float64]) -> NDArray[np.float64]:
    if noise.range_law.shape[0] == 1:
        return np.atleast_1d(noise.range_sigma(typical[0]))
    return noise.range_law[:, 0]


def _law(
    noise: NoiseModel,
    scale: float,
    typical: NDArray[np.float64],
    inverse: bool,
    frame: RangeColorFrame,
    tolerance: float,
) -> NDArray[np.float64]:
    """Coefficients for `local_scales`: sigma and tolerance as polynomials of the whitened first channel."""
    if inverse:
        a, b, c = noise.range_law[0]
        t = typical[0]  # s = t + scale v
        sigma = (a + b * t + c * t * t, (b + 2 * c * t) * scale, c * scale * scale)
        # dz = tolerance z is dw = tolerance w
        return np.array([s / scale for s in sigma] + [tolerance * t / scale, tolerance])
    low, high = np.quantile(frame.points[frame.valid].astype(np.float64), [0.02, 0.98], axis=0)
    extent = float(np.linalg.norm(high - low))
    sigma_m = float(np.sqrt(np.mean(noise.range_law[:, 0] ** 2)))
    return np.array([1.0, 0.0, 0.0, tolerance * extent / sigma_m, 0.0])
