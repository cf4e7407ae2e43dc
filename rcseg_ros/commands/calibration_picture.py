"""The picture of `rcseg calibrate`: error by depth, variance of means by area, map of what stays."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rcseg_core.calibration import Calibration


def write_picture(path: Path, found: Calibration, name: str) -> None:
    """Write the picture as a PNG."""
    # The plain figure class needs no display and leaves the user's matplotlib backend alone.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 4.8), layout="constrained")
    depth, area, pattern = figure.subplots(1, 3)
    figure.suptitle(f"Range error of {name}")
    _draw_depth(depth, found)
    _draw_area(area, found)
    limit = 3.0 * max(float(np.nanstd(found.pattern)), 1e-6)
    shown = pattern.imshow(found.pattern, cmap="coolwarm", vmin=-limit, vmax=limit, interpolation="nearest")
    what = "static views" if found.static_frames else "frames"
    pattern.set_title(f"mean residual, {found.views} {what}; bend {found.bend:.2f} sigma rms")
    pattern.set_facecolor("0.8")
    figure.colorbar(shown, ax=pattern, label="sigma of one pixel", shrink=0.8)
    figure.savefig(path, dpi=100)


def _draw_depth(axes, found: Calibration) -> None:  # type: ignore[no-untyped-def]
    z = np.array([b.depth_m for b in found.bins])
    curve = np.linspace(0.9 * z.min(), 1.1 * z.max(), 100)
    axes.plot(curve, 1e3 * found.sigma(1 / curve) * curve**2, color="0.6", label="law of the file")
    for part, marker in (
        ("random", "o"), ("white", "v"), ("correlated", "^"), ("systematic", "s"), ("temporal", "x"),
        ("fixed", "+"),
    ):  # fmt: skip
        values = 1e3 * np.array([getattr(b, part) for b in found.bins])
        if np.isfinite(values).any():
            axes.plot(z, values, marker, label=part, markersize=7)
    axes.set(xlabel="depth [m]", ylabel="standard deviation [mm]", title="error of one pixel", ylim=(0, None))
    axes.legend()


def _draw_area(axes, found: Calibration) -> None:  # type: ignore[no-untyped-def]
    area = found.sides**2
    axes.loglog(area, found.variances, "o", label="residuals about planes")
    axes.loglog(area, found.fitted, color="C0", label="fitted")
    if np.isfinite(found.temporal_variances).any():
        axes.loglog(area, found.temporal_variances, "x", color="C1", label="changes from frame to frame")
    axes.loglog(area, 1.0 / area, ":", color="0.5", label="white noise")
    axes.axhline(found.systematic**2, ls="--", color="0.5", label=f"systematic {found.systematic:.2f} sigma")
    axes.set(
        xlabel="area [px]",
        ylabel="variance of the mean [that of a pixel]",
        title=f"{found.correlation:.1f} px make one measurement",
        ylim=(0.3 / area[-1], 3.0),
    )
    axes.legend()
