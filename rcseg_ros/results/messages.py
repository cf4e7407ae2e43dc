"""A segmentation as rcseg_msgs/RegionArray: everything that another program needs to evaluate and draw the
regions.

Written once for two message libraries: rclpy's classes on live topics, and the ones that rosbags makes of
the .msg files for result bags. `make("rcseg_msgs/msg/Region", label=1, ...)` is all that differs; numeric
arrays are handed over as numpy arrays, nested messages as made, sequences of messages as lists.
"""

from __future__ import annotations

import array
import importlib
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rcseg_core import LocalCylinder, LocalPlane, LocalSphere, RangeColorFrame, Segmentation
from rcseg_core.result.extents import region_extents
from rcseg_core.tracking import Tracks
from rcseg_core.world import World
from rcseg_ros.patches import bernstein
from rcseg_ros.results.outputs import Make
from rcseg_ros.results.world import objects_of_surfaces, pose_message, surface_fields, up_vector

SHAPE_KINDS = {"none": 0, "plane": 1, "sphere": 2, "cylinder": 3}  # the constants of Primitive.msg
PATCH_KINDS = {"inverse_depth": 1, "xyz": 2, "rgb": 3}  # the constants of BezierPatch.msg


def region_array(
    frame: RangeColorFrame,
    result: Segmentation,
    header: Any,
    make: Make,
    surface: NDArray[np.float32] | None = None,
    geometry: str = "",
    world: World | None = None,
    tracks: Tracks | None = None,
) -> Any:
    """Build the RegionArray of one frame.

    Parameters
    ----------
    frame, result : the input and what `segment` made of it
    header : a std_msgs/Header of the message library that `make` builds for
    make : callable(type name, **fields), `make_rcl` for rclpy
    surface : (H, W, 3) points of the reconstruction, where it is at hand already
    geometry : which camera matrix the frame was seen through, and why, for people
    world : of the up that was told for this frame, where one was
    tracks : names of the regions and surfaces, where they are followed

    Returns
    -------
    rcseg_msgs/RegionArray, as `make` builds it
    """
    if surface is None:
        surface, _ = result.reconstruct()
    world = world or result.world()
    objects = objects_of_surfaces(world, len(result.surfaces))
    extents = region_extents(frame.color, result.labels, result.regions, surface)
    quaternions = Rotation.from_matrix(extents.axes).as_quat() if len(result.regions) else np.empty((0, 4))
    columns = zip(
        result.regions, quaternions.tolist(), extents.center.tolist(), extents.size.tolist(),
        extents.mean_color.astype(np.float32), _range_sigmas(result), strict=True,
    )  # fmt: skip
    regions = [
        make(
            "rcseg_msgs/msg/Region",
            label=region.label,
            surface=region.surface,
            track=0 if tracks is None else int(tracks.region_ids[region.label]),
            pixel_count=region.pixel_count,
            pixels=_pixel_box(region.box, make),
            neighbors=np.array(region.neighbors, np.uint32),
            centroid=_xyz("Point", region.centroid.tolist(), make),
            normal=_xyz("Vector3", region.normal.tolist(), make),
            extent_pose=make(
                "geometry_msgs/msg/Pose",
                position=_xyz("Point", center, make),
                orientation=make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", turn, strict=True))),
            ),
            extent_size=_xyz("Vector3", size, make),
            persistence=region.persistence,
            mean_color=mean_color,
            range_patch=_bezier_patch(region.range_patch, range_sigma, make),
            color_patch=_bezier_patch(region.color_patch, result.noise.color, make),
        )
        for region, turn, center, size, mean_color, range_sigma in columns
    ]
    k = np.zeros((3, 3)) if frame.camera is None else frame.camera.matrix()
    return make(
        "rcseg_msgs/msg/RegionArray",
        header=header,
        height=frame.height,
        width=frame.width,
        k=np.ascontiguousarray(k, np.float64).reshape(9),
        up=up_vector(world, make),
        geometry=geometry,
        regions=regions,
        surfaces=[
            _surface(
                surface,
                0 if tracks is None else int(tracks.surface_ids[surface.label]),
                surface_fields(world, objects, surface.label, make),
                make,
            )
            for surface in result.surfaces
        ],
        hierarchy=_merge_tree(result, make),
        noise=_noise(result, make),
    )


def make_rcl(type_name: str, **fields: Any) -> Any:
    """Build a message of rclpy's class; sequences as array.array, set 100 times faster than numpy."""
    cls, sequences, octets = _rcl_class(type_name)
    for name, value in fields.items():
        if name in sequences and isinstance(value, np.ndarray):
            fields[name] = array.array(value.dtype.char, value.tobytes())
        elif name in octets and isinstance(value, int):
            fields[name] = bytes([value])
    return cls(**fields)


@cache
def _rcl_class(type_name: str) -> tuple[type, frozenset[str], frozenset[str]]:
    package, _, name = type_name.split("/")
    cls = getattr(importlib.import_module(f"{package}.msg"), name)
    kinds = cls.get_fields_and_field_types()
    sequences = frozenset(field for field, kind in kinds.items() if kind.startswith("sequence<"))
    return cls, sequences, frozenset(field for field, kind in kinds.items() if kind == "octet")


def _xyz(kind: str, values: list[float], make: Make) -> Any:
    x, y, z = values
    return make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


def _pixel_box(box: tuple[int, int, int, int], make: Make) -> Any:
    row_min, col_min, row_max, col_max = box
    return make("rcseg_msgs/msg/PixelBox", row_min=row_min, col_min=col_min, row_max=row_max, col_max=col_max)


def _range_sigmas(result: Segmentation) -> list[NDArray[np.float64]]:
    """Sensor noise per range channel at each region's centre: sigma(s) = a + b s + c s^2 of the signal s."""
    patches = [region.range_patch for region in result.regions]
    if not patches:
        return []
    center = np.empty((len(patches), len(patches[0].control_points)))
    for degree in {patch.degree for patch in patches}:
        mine = [i for i, patch in enumerate(patches) if patch.degree == degree]
        low_row, low_col, high_row, high_col = np.array([patches[i].domain for i in mine]).T
        # A domain of one row or column maps to 0.
        u = bernstein(degree, np.where(high_col > low_col, 0.5, 0.0))
        v = bernstein(degree, np.where(high_row > low_row, 0.5, 0.0))
        control = np.stack([patches[i].control_points for i in mine])
        center[mine] = np.einsum("ncij,ni,nj->nc", control, u, v)
    powers = np.stack([np.ones_like(center), center, center**2], axis=2)
    return list((result.noise.range_law * powers).sum(axis=2))


def _bezier_patch(patch: Any, noise_sigma: Any, make: Make) -> Any:
    return make(
        "rcseg_msgs/msg/BezierPatch",
        kind=PATCH_KINDS[patch.kind],
        degree=patch.degree,
        channels=len(patch.control_points),
        domain=_pixel_box(patch.domain, make),
        control_points=_flat(patch.control_points),
        standard_errors=_flat(patch.standard_errors),
        covariance=_flat(patch.covariance),
        noise_sigma=_flat(noise_sigma),
    )


def _flat(values: Any) -> NDArray[np.float64]:
    return np.ascontiguousarray(values, np.float64).ravel()


def _surface(surface: Any, track: int, of_world: dict[str, Any], make: Make) -> Any:
    found = surface.primitive
    values = [np.ravel(value) for value in found.parameters.values()]
    return make(
        "rcseg_msgs/msg/Surface",
        label=surface.label,
        track=track,
        pixel_count=surface.pixel_count,
        pixels=_pixel_box(surface.box, make),
        regions=np.array(surface.regions, np.uint32),
        primitive=make(
            "rcseg_msgs/msg/Primitive",
            kind=SHAPE_KINDS[found.kind],
            parameters=np.concatenate(values) if values else np.empty(0),
            covariance=_flat(found.covariance),
            convex=found.convex,
            rms=found.rms_m,
            rms_sigma=found.rms_sigma,
            misfit=found.misfit_m,
            p_value=found.p_value,
        ),
        **shape_messages(surface.local, make),
        **of_world,
    )


def shape_messages(form: LocalPlane | LocalSphere | LocalCylinder | None, make: Make) -> dict[str, list[Any]]:
    """A shape in minimal local form as fields plane, sphere, cylinder of a message, one of them filled."""
    return {
        "plane": [_plane(form, make)] if isinstance(form, LocalPlane) else [],
        "sphere": [_sphere(form, make)] if isinstance(form, LocalSphere) else [],
        "cylinder": [_cylinder(form, make)] if isinstance(form, LocalCylinder) else [],
    }


def _plane(form: Any, make: Make) -> Any:
    return make("rcseg_msgs/msg/Plane", pose=pose_message(form.pose, make), **_errors(form))


def _sphere(form: Any, make: Make) -> Any:
    center = _xyz("Point", form.center.tolist(), make)
    return make("rcseg_msgs/msg/Sphere", center=center, radius=form.radius, **_errors(form))


def _cylinder(form: Any, make: Make) -> Any:
    pose = pose_message(form.pose, make)
    return make("rcseg_msgs/msg/Cylinder", pose=pose, radius=form.radius, **_errors(form))


def _errors(form: Any) -> dict[str, NDArray[np.float64]]:
    return {"covariance": _flat(form.covariance), "systematic": _flat(form.systematic)}


def _noise(result: Segmentation, make: Make) -> Any:
    noise, scale = result.noise, result.scale
    return make(
        "rcseg_msgs/msg/Noise",
        source=noise.source,
        channels=len(noise.range_law),
        range_law=_flat(noise.range_law),
        range_correlation=float(noise.range_correlation),
        depth=scale.depth_m,
        sigma=scale.sigma_m,
        tolerance=scale.tolerance_m,
        color_sigma=_flat(noise.color),
        color_correlation=float(noise.color_correlation),
    )


def _merge_tree(result: Segmentation, make: Make) -> Any:
    """The part of the merge tree above the regions; below them lie seeds, which messages do not show.

    Of a reduced frame the tree may hold regions that no pixel of the full one shows: they join nothing.
    """
    tree, count = result.hierarchy, len(result.regions)
    number = {int(node): label for label, node in enumerate(result.nodes) if 0 < label <= count}
    parent, height = [0] * count, [1.0] * count
    for merge in np.flatnonzero(tree.heights > 1).tolist():
        below = [number[int(child)] for child in tree.children[merge] if int(child) in number]
        node = tree.leaf_count + 1 + merge
        if len(below) == 2:
            parent.append(0)
            height.append(float(tree.heights[merge]))
            number[node] = len(parent)
            for one in below:
                parent[one - 1] = len(parent)
        elif below:
            number[node] = below[0]
    return make(
        "rcseg_msgs/msg/MergeTree", parent=np.array(parent, np.uint32), height=np.array(height, np.float64)
    )
