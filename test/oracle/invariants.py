"""What holds for every segmentation of every frame, whatever the input and the configuration.

Written against the public contract alone; imports nothing of the product.
"""

import math

import numpy as np


def check_labels(labels, shape):
    """A label image 1..N without gaps; returns N."""
    assert labels.shape == shape
    assert labels.dtype == np.int32
    assert labels.min() >= 0
    present = np.unique(labels)
    present = present[present > 0]
    assert np.array_equal(present, np.arange(1, present.size + 1)), "labels have gaps"
    return present.size


def check_patch(patch, channels, region):
    """Shapes, domain, symmetry; finite values at every pixel of the box."""
    k = patch.degree
    assert 1 <= k <= 4
    assert patch.control_points.shape == (channels, k + 1, k + 1)
    assert patch.standard_errors.shape == patch.control_points.shape
    assert patch.covariance.shape == (channels, channels)
    assert np.isfinite(patch.control_points).all()
    errors = patch.standard_errors
    assert (np.isnan(errors) | (errors >= 0)).all()
    assert np.isfinite(patch.covariance).all()
    assert np.allclose(patch.covariance, patch.covariance.T)
    assert (np.diag(patch.covariance) >= 0).all()
    assert patch.domain == region.box
    row_min, col_min, row_max, col_max = patch.domain
    rows, cols = np.meshgrid([row_min, row_max], [col_min, col_max], indexing="ij")
    values = patch.evaluate(rows, cols)
    assert values.shape == (2, 2, channels)
    assert np.isfinite(values).all()
    # a tensor-product patch passes through its corner control points; u runs along columns, v along rows
    if row_max > row_min and col_max > col_min:
        corners = patch.control_points[:, [0, -1]][:, :, [0, -1]]
        size = np.abs(patch.control_points).max() + 1e-300
        assert np.allclose(np.moveaxis(values, 2, 0), corners.transpose(0, 2, 1), atol=1e-6 * size, rtol=1e-6)


def check_region(region, labels, surfaces, valid, channels):
    here = labels == region.label
    assert region.pixel_count == here.sum() > 0
    rows, cols = np.nonzero(here)
    assert region.box == (rows.min(), cols.min(), rows.max(), cols.max())
    assert (surfaces[here] == region.surface).all(), "a region lies on two surfaces"
    assert region.surface > 0
    assert region.centroid.shape == (3,)
    assert region.normal.shape == (3,)
    assert np.isfinite(region.centroid).all() or np.isnan(region.centroid).all()
    length = float(np.linalg.norm(region.normal))
    assert math.isnan(length) or abs(length - 1) < 1e-9
    assert region.label not in region.neighbors
    assert list(region.neighbors) == sorted(set(region.neighbors))
    check_patch(region.range_patch, channels, region)
    check_patch(region.color_patch, 3, region)


def check_tree(hierarchy):
    """Children come before their parents, have one parent each, and are never higher."""
    leaves, seen = hierarchy.leaf_count, set()
    assert len(hierarchy.heights) == len(hierarchy.children)
    for t, (a, b) in enumerate(np.asarray(hierarchy.children).tolist()):
        node = leaves + 1 + t
        for child in (a, b):
            assert 1 <= child < node
            assert child not in seen, "a node has two parents"
            seen.add(child)
            if child > leaves:
                assert hierarchy.heights[child - leaves - 1] <= hierarchy.heights[t]


def joins_only(fine, coarse):
    """Whether every region of `fine` lies in one region of `coarse`."""
    pairs = np.unique(np.stack([fine.ravel(), coarse.ravel()]), axis=1)
    return len(np.unique(pairs[0])) == pairs.shape[1]


def check_invariants(result, frame, levels=(0.0, 0.5, 1.0, 2.0)):
    """Everything that a Segmentation of a RangeColorFrame promises."""
    shape = frame.points.shape[:2]
    labels, surfaces = result.labels, result.surface_labels
    count = check_labels(labels, shape)
    check_labels(surfaces, shape)
    assert ((labels > 0) == (surfaces > 0)).all()
    assert not labels[~frame.valid].any(), "an invalid pixel is labelled"

    assert len(result.regions) == count
    assert [region.label for region in result.regions] == list(range(1, count + 1))
    sizes = [region.pixel_count for region in result.regions]
    assert sizes == sorted(sizes, reverse=True), "regions are not numbered from the largest down"
    assert sum(sizes) == np.count_nonzero(labels)
    kind = result.regions[0].range_patch.kind if count else None
    assert kind in (None, "inverse_depth", "xyz")
    for region in result.regions:
        assert region.range_patch.kind == kind
        assert region.color_patch.kind == "rgb"
        check_region(region, labels, surfaces, frame.valid, 1 if kind == "inverse_depth" else 3)
        for other in region.neighbors:
            assert region.label in result.regions[other - 1].neighbors, "neighbours are not mutual"
    for a, b in touching(labels):
        assert b in result.regions[a - 1].neighbors, "regions that touch are no neighbours"

    assert result.edges.shape == shape
    assert result.edges.dtype == np.uint8
    assert result.edges.max(initial=0) <= 7
    points, color = result.reconstruct()
    assert points.shape == (*shape, 3)
    assert points.dtype == np.float32
    assert color.shape == (*shape, 3)
    assert color.dtype == np.uint8
    assert np.isnan(points[labels == 0]).all()
    assert not color[labels == 0].any()
    check_reconstruction(result, points, color)
    assert result.timings and all(seconds >= 0 for seconds in result.timings.values())
    check_tree(result.hierarchy)
    finer = None
    for level in levels:
        cut = result.labels_at(level)
        check_labels(cut, shape)
        assert ((cut > 0) == (labels > 0)).all()
        if level == 1.0:
            assert np.array_equal(cut, labels)
        if finer is not None:
            assert joins_only(finer, cut), f"level {level} splits what a finer level had joined"
        finer = cut


def check_reconstruction(result, points, color):
    """The reconstruction is the patches, pixel by pixel: nothing else went into it."""
    for region in result.regions[:4]:
        rows, cols = np.nonzero(result.labels == region.label)
        rows, cols = rows[:: max(1, rows.size // 50)], cols[:: max(1, cols.size // 50)]
        value = region.range_patch.evaluate(rows, cols)
        made = points[rows, cols].astype(float)
        if region.range_patch.kind == "inverse_depth":
            seen = value[:, 0] > 0
            assert np.isnan(made[~seen]).all()
            depth = 1.0 / value[seen, 0]
            camera = result.camera
            direct = np.stack(
                [
                    (cols[seen] - camera.cx) / camera.fx * depth,
                    (rows[seen] - camera.cy) / camera.fy * depth,
                    depth,
                ],
                1,
            )
            assert np.allclose(made[seen], direct, rtol=2e-3, atol=0)
        else:
            assert np.allclose(made, value, rtol=1e-3, atol=1e-4 * (np.abs(value).max() + 1e-300))
        wanted = np.clip(region.color_patch.evaluate(rows, cols), 0, 255)
        assert np.abs(color[rows, cols] - wanted).max() <= 0.51


def touching(labels):
    """Pairs (a, b), both ways round, of positive labels with a common pixel side."""
    found = set()
    for one, other in ((labels[1:], labels[:-1]), (labels[:, 1:], labels[:, :-1])):
        differ = (one != other) & (one > 0) & (other > 0)
        pairs = set(zip(one[differ].tolist(), other[differ].tolist(), strict=True))
        found |= pairs | {(b, a) for a, b in pairs}
    return found
