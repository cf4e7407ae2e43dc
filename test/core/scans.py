"""Scans of planes, boxes and balls along given rays, with exact truth, for grids without a camera.

Plain formulas of analytic geometry; nothing of the product but the frame itself.
"""

import numpy as np

from rcseg_core import RangeColorFrame


def spherical_rays(elevation_deg, azimuth_deg, axes=None):
    """(H, W, 3) unit directions; by default x right, y down, z ahead, with elevation upwards.

    axes : (3, 3), columns are the images of x, y, z; another frame of the points
    """
    up = np.deg2rad(np.asarray(elevation_deg, float))[:, None]
    around = np.deg2rad(np.asarray(azimuth_deg, float))[None, :]
    rays = np.stack(
        [np.cos(up) * np.sin(around), -np.sin(up) + 0 * around, np.cos(up) * np.cos(around)], axis=-1
    )
    return rays if axes is None else rays @ np.asarray(axes).T


def tilt(x_deg, y_deg, z_deg):
    """Rotation about x, then y, then z."""
    out = np.eye(3)
    for axis, angle in enumerate(np.deg2rad([x_deg, y_deg, z_deg])):
        i, j = [k for k in range(3) if k != axis]
        turn = np.eye(3)
        turn[i, i] = turn[j, j] = np.cos(angle)
        turn[i, j], turn[j, i] = -np.sin(angle), np.sin(angle)
        out = turn @ out
    return out


#: Planes n.p = d (the floor 0.6 m below, a wall ahead and one to the right), boxes by two corners, a ball.
PLANES = (((0, 1, 0), 0.6), ((0.1, 0, 1), 2.6), ((1, 0, 0.15), 1.5))
BOXES = (((-0.55, 0.1, 1.5), (0.1, 0.6, 1.9)),)
BALL = ((0.75, 0.25, 1.9), 0.35)
#: Boxes in the hand's size on the floor of a hall.
HALL = (((0, 1, 0), 1.2), ((0.1, 0, 1), 6.0), ((1, 0, 0.15), 3.5))
SMALL_BOXES = tuple(
    ((x, 1.2 - h, z), (x + 0.3, 1.2, z + 0.3))
    for x, z, h in ((-1.3, 2.0, 0.3), (-0.8, 2.6, 0.35), (0.45, 2.1, 0.25), (1.0, 2.7, 0.3), (0.3, 3.1, 0.4))
)
BALL_SURFACE = 99


def cast(rays, planes=PLANES, boxes=BOXES, ball=BALL):
    """Range (H, W) along unit rays from the origin, NaN for nothing, and the surface (H, W) that is met.

    Surfaces: 1, 2, 3 planes in their order, 10, 11, 12 sides of the first box whose normal lies along x, y,
    z, then 20 to 22 of the second, ...; 99 the ball.
    """
    near = np.full(rays.shape[:2], np.inf)
    surface = np.zeros(rays.shape[:2], np.int32)

    def take(distance, value):
        hit = (distance > 1e-9) & (distance < near)
        near[hit] = distance[hit]
        surface[hit] = np.broadcast_to(value, near.shape)[hit]

    with np.errstate(divide="ignore", invalid="ignore"):
        for number, (normal, offset) in enumerate(planes, 1):
            take(offset / (rays @ np.asarray(normal, float)), number)
        for number, box in enumerate(boxes, 1):
            slabs = np.asarray(box, float)[:, None, None, :] / rays
            enter, leave = slabs.min(axis=0), slabs.max(axis=0)
            first, side = enter.max(axis=-1), enter.argmax(axis=-1)
            take(np.where(first < leave.min(axis=-1), first, np.inf), 10 * number + side)
        if ball is not None:
            along = rays @ np.asarray(ball[0], float)
            root = along**2 - np.dot(ball[0], ball[0]) + ball[1] ** 2
            take(np.where(root > 0, along - np.sqrt(np.maximum(root, 0)), np.inf), BALL_SURFACE)
    return np.where(np.isfinite(near), near, np.nan), surface


def frame_of(rays, range_m, sigma=0.0, seed=0, color=None):
    """A frame without camera whose range has white noise along the rays."""
    noise = sigma * np.random.default_rng(seed).normal(size=range_m.shape)
    points = (rays * (range_m + noise)[..., None]).astype(np.float32)
    if color is None:
        color = np.full(points.shape, 128, np.uint8)
    return RangeColorFrame(points, color)


def room_scan(height=150, width=190, *, sigma=0.002, seed=0, axes=None, **scene):
    """The scene from a scanner of 60 x 70 degrees: the frame and its surfaces."""
    straight = spherical_rays(np.linspace(25, -35, height), np.linspace(-35, 35, width))
    range_m, surface = cast(straight, **scene)
    rays = straight if axes is None else straight @ np.asarray(axes).T
    return frame_of(rays, range_m, sigma, seed), surface
