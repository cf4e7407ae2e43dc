"""Same input, same configuration: same labels, bit for bit, in every run and every process."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rcseg_core import SegmenterConfig, segment
from rcseg_core.compute import parallel
from rcseg_core.synthetic import make_scene

REPOSITORY = Path(__file__).resolve().parents[2]

PROGRAM = """
import hashlib, sys
import numpy as np
from rcseg_core import RangeColorFrame, SegmenterConfig, segment
from rcseg_core.synthetic import make_scene
family, seed, width, height, literal, threads = sys.argv[1:]
import cv2; cv2.setNumThreads(int(threads))
frame = make_scene(family, int(seed), width=int(width), height=int(height)).frame
result = segment(frame, SegmenterConfig.literal() if literal == "literal" else SegmenterConfig())
parts = (result.labels, result.surface_labels, result.labels_at(3.0))
digest = hashlib.sha256(b"".join(part.tobytes() for part in parts))
print(digest.hexdigest())
"""


def digest(result):
    parts = (result.labels, result.surface_labels, result.labels_at(3.0))
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


def in_a_process(family, seed, width, height, literal="default", threads="1", **environment):
    arguments = [family, str(seed), str(width), str(height), literal, threads]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *arguments], cwd=REPOSITORY, env=os.environ | environment,
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize("family", ["room", "billiard"])
def test_runs_in_one_process_agree_to_the_last_bit(family):
    scene = make_scene(family, 107, width=160, height=120, outliers=0.05)
    one, two = segment(scene.frame), segment(scene.frame)
    assert digest(one) == digest(two)
    assert np.array_equal(one.edges, two.edges)
    for a, b in zip(one.regions, two.regions, strict=True):
        assert np.array_equal(a.range_patch.control_points, b.range_patch.control_points)
        assert np.array_equal(a.color_patch.standard_errors, b.color_patch.standard_errors, equal_nan=True)
        assert np.array_equal(a.normal, b.normal)
    assert np.array_equal(one.hierarchy.children, two.hierarchy.children)
    assert np.array_equal(one.hierarchy.heights, two.hierarchy.heights)


@pytest.mark.parametrize("literal", ["default", "literal"])
def test_processes_agree_whatever_their_hash_seed_and_threads(literal):
    config = SegmenterConfig.literal() if literal == "literal" else SegmenterConfig()
    here = digest(segment(make_scene("room", 107, width=160, height=120).frame, config))
    for seed, threads in (("1", "1"), ("4242", "4")):
        there = in_a_process(
            "room", 107, 160, 120, literal, threads,
            PYTHONHASHSEED=seed, RCSEG_THREADS=threads, OMP_NUM_THREADS=threads,
        )  # fmt: skip
        assert there == here


@pytest.mark.parametrize("family", ["room", "curved"])
def test_the_number_of_threads_changes_nothing(family):
    """At a size with several bands of rows for every pass."""
    frame = make_scene(family, 106, width=480, height=360, outliers=0.03).frame
    found = []
    try:
        for number in (1, 2, 3, 7):
            parallel.set_threads(number)
            found.append(segment(frame))
    finally:
        parallel.set_threads(0)
    for other in found[1:]:
        assert digest(other) == digest(found[0])
        for a, b in zip(found[0].regions, other.regions, strict=True):
            assert np.array_equal(a.range_patch.control_points, b.range_patch.control_points)
