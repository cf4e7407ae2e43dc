"""Planes, spheres and cylinders: right when they are there, with honest errors, "none" when they are not."""

import numpy as np
import pytest

from rcseg_core import PinholeCamera, RangeColorFrame, segment
from rcseg_core.shapes.cells import gather_cells
from rcseg_core.shapes.fitting import fit_shape, start_cylinder, start_sphere
from rcseg_core.shapes.primitives import NONE
from rcseg_core.synthetic import make_scene

KINECT_SIGMA_INVERSE_M = 1.425e-3
CAMERA = PinholeCamera(262.5, 262.5, 159.5, 119.5)
SHAPE = (240, 320)


def frame_of(depth_m, inside, seed=0, noise=1.0):
    rng = np.random.default_rng(seed)
    w = 1.0 / depth_m + noise * KINECT_SIGMA_INVERSE_M * rng.normal(size=SHAPE)
    color = np.where(inside[..., None], (150, 120, 90), (60, 70, 100)) + rng.normal(0, 3, (*SHAPE, 3))
    return RangeColorFrame.from_depth(
        (1.0 / w).astype(np.float32), np.clip(color, 0, 255).astype(np.uint8), CAMERA
    )


def relief(height, z0=1.2, half=0.35):
    """Depth of z = z0 + height(x, y) in a square window before a wall, along each ray (fixed point)."""
    rays = CAMERA.rays(*SHAPE).astype(float)
    z = np.full(SHAPE, z0)
    for _ in range(200):
        x, y = np.clip(rays[..., 0] * z, -1, 1), np.clip(rays[..., 1] * z, -1, 1)
        z = np.clip(0.5 * z + 0.5 * (z0 + height(x, y)), 0.3, 3.0)
    inside = (np.abs(rays[..., 0] * z) < half) & (np.abs(rays[..., 1] * z) < half)
    return np.where(inside, z, 2.2), inside


def ellipsoid(axes):
    """Depth of an ellipsoid at (0, 0, 1.2) before a wall."""
    rays = CAMERA.rays(*SHAPE).astype(float)
    form, center = np.diag(1 / np.square(axes)), np.array([0, 0, 1.2])
    a, b = np.einsum("hwi,ij,hwj->hw", rays, form, rays), rays @ form @ center
    root = b * b - a * (center @ form @ center - 1)
    return np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, 2.2), root > 0


def surface_at(frame, inside):
    result = segment(frame)
    labels = result.surface_labels[inside & (result.surface_labels > 0)]
    surface = result.surfaces[np.bincount(labels).argmax() - 1]
    assert surface.pixel_count > 0.9 * inside.sum(), "the surface is whole, or this tests nothing"
    return surface


OTHERS = {
    "saddle": lambda: relief(lambda x, y: 0.5 * (x * x - y * y)),
    "paraboloid": lambda: relief(lambda x, y: 1.5 * (x * x + y * y)),
    "parabolic groove": lambda: relief(lambda x, y: 1.8 * x * x),
    "long ellipsoid": lambda: ellipsoid((0.2, 0.3, 0.2)),
    "flat ellipsoid": lambda: ellipsoid((0.3, 0.3, 0.1)),
}


@pytest.mark.parametrize("name", OTHERS)
def test_other_shapes_are_none_of_these(name):
    depth, inside = OTHERS[name]()
    surface = surface_at(frame_of(depth, inside), inside)
    assert surface.primitive.kind == "none", surface.primitive
    assert surface.primitive is NONE and surface.primitive.standard_errors == {}
    assert [c.kind for c in surface.candidates][:2] == ["plane", "sphere"]
    assert all(c.p_value < 0.01 for c in surface.candidates if c.arc > 0.35)


@pytest.mark.parametrize("radius, kinds", [(0.5, {"cylinder"}), (3.0, {"none", "plane"}), (30.0, {"plane"})])
def test_a_small_arc_is_no_cylinder(radius, kinds):
    depth, inside = relief(lambda x, y: radius - np.sqrt(radius**2 - np.clip(x, -0.45, 0.45) ** 2))
    surface = surface_at(frame_of(depth, inside), inside)
    assert surface.primitive.kind in kinds
    if "cylinder" in kinds:
        found = surface.primitive
        assert found.convex
        assert abs(found.parameters["axis"][1]) > 0.999
        assert abs(found.parameters["radius"] - radius) < 4 * found.standard_errors["radius"]
        assert found.standard_errors["radius"] < 0.01


def test_a_plane_that_a_sensor_bends_is_a_plane():
    """A bow of 2.3 mm rms at 1.2 m, as depth cameras bend planes, passes where no curved shape fits."""
    depth, inside = relief(lambda x, y: x**2 / 16)
    surface = surface_at(frame_of(depth, inside), inside)
    strict, bent = surface.candidates[0], surface.primitive
    assert strict.p_value < 0.01 <= bent.p_value
    assert bent.kind == "plane"
    assert bent.misfit_m == strict.misfit_m == pytest.approx(2.3e-3, rel=0.2)
    np.testing.assert_allclose(bent.parameters["normal"], (0, 0, -1), atol=5e-3)


def test_a_bowl_is_a_sphere_seen_from_inside():
    depth, inside = relief(lambda x, y: np.sqrt(0.5**2 - np.clip(x * x + y * y, 0, 0.24)) - 0.5)
    found = surface_at(frame_of(depth, inside), inside).primitive
    assert found.kind == "sphere" and not found.convex
    assert found.parameters["radius"] == pytest.approx(0.5, abs=0.01)
    np.testing.assert_allclose(found.parameters["center"], (0, 0, 0.7), atol=0.01)


def true_kind(scene, mask):
    """Kind of a truth surface from its exact normals: one direction, one great circle, or neither."""
    normals = scene.normals[mask].astype(float)
    values = np.linalg.eigvalsh(normals.T @ normals / len(normals))
    if values[1] < 1e-6:
        return "plane"
    return "cylinder" if values[0] < 1e-6 else "sphere"


def misses(scene, mask, found):
    """Distances (n,) of exact points of the truth to a found primitive, m."""
    points = scene.clean_points[mask]
    values = found.parameters
    if found.kind == "plane":
        return points @ values["normal"] - values["distance"]
    local = points - values["center" if found.kind == "sphere" else "point"]
    if found.kind == "cylinder":
        local = local - (local @ values["axis"])[:, None] * values["axis"]
    return np.linalg.norm(local, axis=1) - values["radius"]


def recognised(family, seed, **options):
    """(truth kind, Primitive, truth mask, scene) of each surface that is pure to 99 % and large enough."""
    scene = make_scene(family, seed, **options)
    result = segment(scene.frame)
    for surface in result.surfaces:
        mask = result.surface_labels == surface.label
        truth = np.bincount(scene.surface_labels[mask])
        if surface.pixel_count >= 600 and truth[1:].max(initial=0) > 0.99 * surface.pixel_count:
            own = mask & (scene.surface_labels == 1 + truth[1:].argmax())
            yield true_kind(scene, own), surface.primitive, own, scene


@pytest.mark.parametrize("family, seeds", [("curved", (0, 1, 2)), ("room", (1, 3)), ("blocks", (0,))])
def test_scenes_are_recognised_to_a_fraction_of_the_noise(family, seeds):
    kinds = set()
    for seed in seeds:
        for kind, found, mask, scene in recognised(family, seed):
            assert found.kind == kind, (seed, kind, found)
            kinds.add(kind)
            # 2000 pixels and more tell where the surface is to a fifth of one pixel's noise
            sigma = np.median(scene.sigma_range[mask])
            least = 0.2 if mask.sum() >= 2000 else 0.5
            assert np.sqrt(np.mean(misses(scene, mask, found) ** 2)) < least * sigma, (seed, kind)
            assert 0.85 < found.rms_sigma < 1.35 and found.p_value > 0.01
    assert kinds == {"curved": {"plane", "sphere", "cylinder"}, "room": {"plane", "sphere", "cylinder"},
                     "blocks": {"plane"}}[family]  # fmt: skip


def test_radii_err_as_much_as_they_say():
    """Balls and cylinders of five scenes; a fit to the exact points of each is its truth."""
    scores = []
    for seed in range(3, 8):
        for kind, found, mask, scene in recognised("curved", seed, width=480, height=360):
            if kind == "plane" or found.kind != kind:
                continue
            points, normals = scene.clean_points[mask], scene.normals[mask].astype(float)
            weight = np.full(len(points), 1 / len(points))
            start = (
                start_sphere(points, weight) if kind == "sphere" else start_cylinder(points, normals, weight)
            )
            spread = np.tile(1e-6 * np.eye(3), (len(points), 1, 1))
            exact, _ = fit_shape(start, points, spread, np.full(len(points), 1e9))
            scores.append((found.parameters["radius"] - exact.radius) / found.standard_errors["radius"])
    assert len(scores) >= 15
    assert 0.6 < np.sqrt(np.mean(np.square(scores))) < 1.5, np.round(scores, 1)
    assert abs(np.mean(scores)) < 0.5, "no radius is biased"


def test_balls_on_a_scanner_grid():
    for seed in range(3):
        for kind, found, mask, scene in recognised("billiard", seed):
            assert found.kind == kind
            assert np.sqrt(np.mean(misses(scene, mask, found) ** 2)) < 5e-5


def test_planes_of_a_structured_light_sensor_stay_planes():
    """Correlated noise and 1/8 px of quantisation do not count as misfit, and nothing flat becomes round."""
    found = [(kind, p.kind) for kind, p, _, _ in recognised("room", 4, structured_light=True)]
    assert sum(pair == ("plane", "plane") for pair in found) >= 5
    assert all(p in ("plane", "none") for kind, p in found if kind == "plane")
    assert sum(pair == ("plane", "none") for pair in found) <= 1


def test_surfaces_say_what_the_images_say():
    scene = make_scene("room", 2, width=240, height=180)
    result = segment(scene.frame)
    assert [s.label for s in result.surfaces] == list(range(1, int(result.surface_labels.max()) + 1))
    for surface in result.surfaces:
        rows, cols = np.nonzero(result.surface_labels == surface.label)
        assert surface.pixel_count == rows.size
        assert surface.box == (rows.min(), cols.min(), rows.max(), cols.max())
        assert set(surface.regions) == set(np.unique(result.labels[rows, cols]))
    assert result.surfaces is result.surfaces, "found once"


def test_few_pixels_tell_nothing():
    scene = make_scene("room", 2, width=64, height=48)
    result = segment(scene.frame)
    for surface in result.surfaces:
        if surface.pixel_count < 8:
            assert surface.primitive is NONE
        for name, error in surface.primitive.standard_errors.items():
            assert np.isfinite(error).all(), name


@pytest.mark.parametrize("camera", [True, False])
def test_cells_lie_on_the_surface_and_count_every_pixel_once(camera):
    depth, inside = ellipsoid((0.2, 0.2, 0.2))
    frame = frame_of(depth, inside, noise=0.02)
    frame = frame if camera else RangeColorFrame(frame.points, frame.color)
    result = segment(frame)
    surface = result.surface_labels[120, 160]
    cells = gather_cells(result.labels, result.surface_labels, result.signals, result.models, frame.camera)
    own = cells[surface - 1]
    assert len(own.points) <= 1300
    assert own.pixels.sum() <= (result.surface_labels == surface).sum()
    assert own.pixels.sum() > 0.8 * (result.surface_labels == surface).sum()
    off = np.linalg.norm(own.points - (0, 0, 1.2), axis=1) - 0.2
    cosine = (
        -np.sum((own.points - (0, 0, 1.2)) * own.points, axis=1) / 0.2 / np.linalg.norm(own.points, axis=1)
    )
    # noise is 0.03 mm; the mean over a cell of a ball of 44 px radius would be off by 0.2 mm at 45 degrees
    assert np.abs(off[cosine > 0.7]).max() < 2e-4
    turned = np.abs(np.sum(own.normals * (own.points - (0, 0, 1.2)), axis=1)) / 0.2
    assert np.median(turned[cosine > 0.7]) > 0.99
