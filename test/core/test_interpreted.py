"""The kernels without their compiler: the same labels, and their own tests pass (a bug of types or of the
compiler cannot hide)."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_determinism import REPOSITORY, digest, in_a_process

from rcseg_core import segment
from rcseg_core.synthetic import make_scene

#: Tests of kernels on small arrays; those of whole frames would take minutes without the compiler.
KERNEL_TESTS = (
    "moments", "planes", "adjacency", "evidence", "grouping", "models", "continuity", "hierarchy", "cleaning",
    "generalization", "partition", "rendering", "shapes", "extents", "borders", "gaps",
    "views", "registration", "parting", "spread", "world_outlines", "tracking_kernels", "surface_kernels",
    "stability",
)  # fmt: skip
SLOW = (
    "vga or noise_alone or null_hypothesis or pure_noise or many_small or as_large_as_they_say or "
    "creases_of_scenes or filled_holes_take or missing_columns or correlated_error_alone or "
    # whole frames and descriptions of test_spread and test_parting, which compares both forms of its own
    "white_noise_is_white or pixels_of_one_measurement or a_bend_wider or things_holes or constant_depth or "
    "simulated_noise or over_the_whole_image or bent_themselves or what_windows_saw or "
    "a_roof_is_parted or three_faces or move_the_ridge or lid_of_a_can or surface_stays_whole or "
    "motion_is_found_where or wall_alone_holds or as_uncertain_as_it_says or "
    "surfaces_of_a_room or curved_surfaces_have or grids_without or "
    "stands_alone or without_stability or same_results or what_the_last_frame or under_noise_are or "
    "begin_anew_so or other_images_of_a_scene or do_not_fit_are or "
    "crease_within or asks_for_more or parallel_planes or of_a_beam or is_split_and or no_longer_than"
)

interpreted = pytest.mark.skipif(
    bool(os.environ.get("NUMBA_DISABLE_JIT")), reason="this run is interpreted already"
)


@interpreted
def test_kernels_pass_their_tests_without_the_compiler():
    here = Path(__file__).parent
    done = subprocess.run(
        [
            sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-k", f"not ({SLOW})",
            *(str(here / f"test_{name}.py") for name in KERNEL_TESTS),
        ],
        cwd=REPOSITORY, env=os.environ | {"NUMBA_DISABLE_JIT": "1"}, capture_output=True, text=True,
        timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:]
    assert " passed" in done.stdout


@interpreted
@pytest.mark.parametrize("literal", ["default", "literal"])
def test_a_frame_gets_the_same_labels_without_the_compiler(literal):
    from rcseg_core import SegmenterConfig

    config = SegmenterConfig.literal() if literal == "literal" else SegmenterConfig()
    scene = make_scene("room", 108, width=48, height=40)
    assert segment(scene.frame, config).labels.max() >= 3
    here = digest(segment(scene.frame, config))
    assert in_a_process("room", 108, 48, 40, literal, NUMBA_DISABLE_JIT="1") == here
